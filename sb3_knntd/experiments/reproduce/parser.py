"""The parser of ``sb3-knntd reproduce``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_knntd.common.command_line import add_seeds, chosen_seeds, positive_int, require, run_resumable
from sb3_knntd.experiments.reproduce import FIGURES

if TYPE_CHECKING:
    from sb3_knntd.common.command_line import Subparsers


def add_reproduce(subparsers: Subparsers) -> None:
    """
    :param subparsers: where to add the command
    """
    parser = subparsers.add_parser(
        "reproduce",
        help="compute a figure of the paper over many seeds",
        description="Compute a figure of the paper over many seeds, and write a table (CSV), a picture (PNG) and a "
        "verdict, the paper's numbers beside ours. What is interrupted goes on where it was.",
    )
    figures = "; ".join(f"{name}: {figure.help}" for name, figure in FIGURES.items())
    parser.add_argument("figure", choices=FIGURES, metavar="FIGURE", help=figures)
    parser.add_argument("--best", action="store_true", help="this project's best settings, not the paper's")
    add_seeds(parser, 30, "the best settings were tuned on seeds below 1000")
    parser.add_argument("--episodes", type=positive_int, metavar="N", help="episodes of each seed")
    parser.add_argument("--workers", type=positive_int, metavar="N", help="processes (default: one a core)")
    parser.add_argument(
        "--out", type=Path, default=Path("results"), metavar="DIR", help="folder for all files (default: %(default)s)"
    )
    parser.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    require("tqdm", "matplotlib", "yaml")
    from sb3_knntd.experiments.reproduce.command import reproduce

    seeds = chosen_seeds(args)
    return run_resumable(
        lambda: reproduce(args.figure, args.best, seeds, args.episodes, args.out, args.workers), args.out
    )
