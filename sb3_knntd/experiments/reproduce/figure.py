"""The interface of a figure of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from sb3_knntd.experiments.reproduce.settings import Setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Return values of a figure's ``compute`` by algorithm and seed.
Results = Mapping[str, Mapping[int, Any]]


class Table(NamedTuple):
    """
    A table that is written as CSV.

    :param header: names of the columns
    :param rows: one value per column; ``None`` for missing values
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]


class PaperFigure(NamedTuple):
    """
    A figure of the paper. Its settings are under its name in ``zoo_configs/paper.yml``.

    :param name: name on the command line
    :param help: help text of the command line
    :param min_episodes: smallest number of episodes that gives a result
    :param compute: maps algorithm, setting and seed to a JSON-serializable result, in a separate process
    :param tables: maps the results to tables by file name
    :param draw: maps the results and a title to a plot
    :param verdict: maps the results to a paragraph that compares them with the paper
    """

    name: str
    help: str
    min_episodes: int
    compute: Callable[[str, Setting, int], Any]
    tables: Callable[[Results], Mapping[str, Table]]
    draw: Callable[[Results, str], Figure]
    verdict: Callable[[Results], str]
