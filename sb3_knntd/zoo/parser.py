"""The commands of RL Zoo: ``train``, ``enjoy`` and so on."""

from __future__ import annotations

import argparse
import traceback
from typing import TYPE_CHECKING

from sb3_knntd.common.command_line import CommandError, reason_of, require
from sb3_knntd.zoo.scripts import SCRIPTS, run

if TYPE_CHECKING:
    from sb3_knntd.common.command_line import Subparsers


def add_zoo(subparsers: Subparsers) -> None:
    """
    Add RL Zoo's scripts, each as a command that takes RL Zoo's own arguments.

    :param subparsers: where to add them
    """
    for name, script in SCRIPTS.items():
        # No argument can begin with a zero byte: all are taken as they are, and RL Zoo reads them.
        parser = subparsers.add_parser(name, help=script.help, add_help=False, prefix_chars="\0")
        parser.add_argument("arguments", nargs=argparse.REMAINDER)
        parser.set_defaults(run=_run_zoo)


def _run_zoo(args: argparse.Namespace) -> int:
    require("rl_zoo3", *SCRIPTS[args.command].needs, extra="zoo")
    try:
        run(args.command, args.arguments)
    except FloatingPointError as error:
        # Action values that diverge; the message says what to change.
        raise CommandError(str(error)) from error
    except Exception as error:
        if _is_at_work(error):
            raise
        # RL Zoo checks few of its arguments: what they lead to, until there is something to train, is its answer.
        raise CommandError(reason_of(error)) from error
    return 0


def _is_at_work(error: Exception) -> bool:
    """Whether it was raised when learning had begun, or an environment was stepped: no matter of arguments."""
    names = {frame.name for frame in traceback.extract_tb(error.__traceback__)}
    return ("learn" in names and "_setup_learn" not in names) or not names.isdisjoint({"step", "predict"})
