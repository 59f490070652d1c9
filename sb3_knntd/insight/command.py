"""``sb3-knntd inspect``: write the page of a saved model."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_knntd.common.command_line import CommandError, require
from sb3_knntd.common.files import read_description
from sb3_knntd.insight.inspectable import Inspectable
from sb3_knntd.insight.page import Episodes, read_monitor, write_page
from sb3_knntd.plots import names_in
from sb3_knntd.registry import ALGORITHMS

if TYPE_CHECKING:
    from sb3_knntd.common.command_line import Subparsers


def add_inspect(subparsers: Subparsers) -> None:
    """
    :param subparsers: where to add the command
    """
    parser = subparsers.add_parser(
        "inspect",
        help="write a page that shows what a saved model has learned",
        description="Write one self-contained page for the browser: value, greedy action and visits over any two "
        "dimensions, the neighbours of a state and their values, what may be wrong, and the learning curve.",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="file written by model.save")
    parser.add_argument("--out", type=Path, metavar="FILE", help="page to write (default: MODEL with .html)")
    parser.add_argument(
        "--monitor", type=Path, metavar="FILE", help="file of SB3's Monitor, for the learning curve and the names"
    )
    parser.add_argument(
        "--env", metavar="ID", help="gymnasium id, for the names of dimensions and actions (default: that in --monitor)"
    )
    parser.add_argument(
        "--trusted", action="store_true", help="also unpickle functions in the file, which can execute any code"
    )
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    require("plotly", extra="inspect")
    out = args.out or args.model.with_suffix(".html")
    try:
        episodes = None if args.monitor is None else read_monitor(args.monitor)
        model = _load(args.model, args.trusted)
        inspect(model, out, episodes, args.env)
    except (ValueError, OSError) as error:
        raise CommandError(str(error)) from error
    print(out)
    return 0


def inspect(model: Inspectable, out: Path, episodes: Episodes | None, env_id: str | None) -> None:
    """
    Write the page of a model, with the findings of its diagnosis.

    :param model: the model
    :param out: the page
    :param episodes: the episodes of its training
    :param env_id: gymnasium id of its environment; by default that of the episodes
    """
    env_id = env_id or (episodes.env_id if episodes else "")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_page(model, out, episodes, names_in(env_id, model), env_id)


def _load(path: Path, trusted: bool) -> Inspectable:
    name = read_description(path).get("algorithm")
    for algorithm in ALGORITHMS.values():
        # The files of a subclass hold the name of the class that can load them.
        if algorithm.entry_point.rpartition(":")[2] == name:
            cls = algorithm.load()
            if issubclass(cls, Inspectable):
                model: Inspectable = cls.load(path, trusted=trusted)
                return model
    raise ValueError(f"{path} holds no model of this package that has a table; its algorithm is {name or 'unknown'}")
