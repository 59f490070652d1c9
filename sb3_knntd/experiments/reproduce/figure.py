"""What a figure of the paper is, to the command that reproduces it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from sb3_knntd.experiments.reproduce.settings import Setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: By algorithm and seed, what ``compute`` of a figure returned.
Results = Mapping[str, Mapping[int, Any]]


class Table(NamedTuple):
    """
    :param header: names of the columns
    :param rows: as many values each; ``None`` for one that is not there
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]


class PaperFigure(NamedTuple):
    """
    A figure of the paper. Its settings stand under its name in ``zoo_configs/paper.yml``.

    :param name: what it is called on the command line
    :param help: what is computed, in a few words
    :param min_episodes: with fewer it tells nothing
    :param compute: from algorithm, setting and seed to what JSON can hold, in a process of its own
    :param tables: from the results to CSV files, by file name
    :param draw: from the results and a title to a picture
    :param verdict: from the results to a paragraph, the paper's figures beside ours
    """

    name: str
    help: str
    min_episodes: int
    compute: Callable[[str, Setting, int], Any]
    tables: Callable[[Results], Mapping[str, Table]]
    draw: Callable[[Results, str], Figure]
    verdict: Callable[[Results], str]
