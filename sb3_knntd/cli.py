"""The command ``sb3-knntd``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sb3_knntd.zoo import SCRIPTS
from sb3_knntd.zoo import run as run_script

if TYPE_CHECKING:
    # argparse's own class is generic only in type stubs.
    Subparsers = argparse._SubParsersAction["Parser"]
    AddCommand = Callable[[Subparsers], None]

#: Exit code after Ctrl-C, the shell's own for it.
INTERRUPTED = 130


class CommandError(Exception):
    """What was asked for cannot be done. The user is shown the message alone, without a traceback."""


class Parser(argparse.ArgumentParser):
    """Reports a mistake in one line: with the usage before it the reason would be hard to see."""

    def error(self, message: str) -> NoReturn:
        """
        :param message: what is wrong
        :raises SystemExit: with code 2, always
        """
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}\n")


def positive_int(text: str) -> int:
    """
    :param text: argument of the command line
    :return: the integer it is
    :raises argparse.ArgumentTypeError: if it is none, or less than 1
    """
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1; got {text!r}")
    return number


def seed_int(text: str) -> int:
    """
    :param text: argument of the command line
    :return: the integer it is
    :raises argparse.ArgumentTypeError: if it is none, or no seed NumPy takes
    """
    try:
        number = int(text)
    except ValueError:
        number = -1
    if not 0 <= number < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 2147483647; got {text!r}")
    return number


def require(*modules: str, extra: str = "extra") -> None:
    """
    :param modules: modules that the command cannot do without
    :param extra: extra of this package that installs them
    :raises CommandError: if some of them are not installed
    """
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise CommandError(f'{" and ".join(missing)} not installed: pip install "sb3-knntd[{extra}]"')


def _add_demo(subparsers: Subparsers) -> None:
    parser = subparsers.add_parser(
        "demo",
        help="train on an environment and show what was learned",
        description="Train KNNTD on an environment, save and reload the model, evaluate it beside a random policy, "
        "and draw its learning curve and value function.",
    )
    parser.add_argument("--env", default="MountainCar-v0", metavar="ID", help="gymnasium id (default: %(default)s)")
    parser.add_argument(
        "--steps", type=positive_int, default=50_000, metavar="N", help="environment steps (default: %(default)s)"
    )
    parser.add_argument("--seed", type=seed_int, default=0, metavar="N", help="random seed (default: %(default)s)")
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder for all files (default: %(default)s)"
    )
    parser.set_defaults(run=_run_demo)


def _run_demo(args: argparse.Namespace) -> int:
    require("tqdm", "rich", "tensorboard", "matplotlib")
    from sb3_knntd.demo import demo

    return 0 if demo(args.env, args.steps, args.seed, args.out) else INTERRUPTED


def _add_reproduce(subparsers: Subparsers) -> None:
    from sb3_knntd.reproduce import FIGURES

    parser = subparsers.add_parser(
        "reproduce",
        help="compute a figure of the paper over many seeds",
        description="Compute a figure of the paper over many seeds, and write a table (CSV), a picture (PNG) and a "
        "verdict, the paper's numbers beside ours. What is interrupted goes on where it was.",
    )
    figures = "; ".join(f"{name}: {figure.help}" for name, figure in FIGURES.items())
    parser.add_argument("figure", choices=FIGURES, metavar="FIGURE", help=figures)
    parser.add_argument("--best", action="store_true", help="this project's best settings, not the paper's")
    parser.add_argument(
        "--seeds", type=positive_int, default=30, metavar="N", help="number of seeds (default: %(default)s)"
    )
    parser.add_argument(
        "--first-seed",
        type=seed_int,
        default=1000,
        metavar="N",
        help="the best settings were tuned on seeds below 1000 (default: %(default)s)",
    )
    parser.add_argument("--episodes", type=positive_int, metavar="N", help="episodes of each seed")
    parser.add_argument("--workers", type=positive_int, metavar="N", help="processes (default: one a core)")
    parser.add_argument(
        "--out", type=Path, default=Path("results"), metavar="DIR", help="folder for all files (default: %(default)s)"
    )
    parser.set_defaults(run=_run_reproduce)


def _run_reproduce(args: argparse.Namespace) -> int:
    require("tqdm", "matplotlib", "yaml")
    from sb3_knntd.reproduce.command import reproduce

    seeds = range(args.first_seed, args.first_seed + args.seeds)
    if seeds[-1] >= 2**31:
        raise CommandError(f"seeds go to 2147483647; got {args.seeds} from {args.first_seed} on")
    try:
        return reproduce(args.figure, args.best, seeds, args.episodes, args.out, args.workers)
    except KeyboardInterrupt:
        print(
            f"\nInterrupted. What is finished is in {args.out}: the same command goes on from there.", file=sys.stderr
        )
        return INTERRUPTED


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
    run_script(args.command, args.arguments)
    return 0


#: Each adds one command or several: the parser, and with ``set_defaults(run=...)`` the function that runs it and
#: returns the exit code.
COMMANDS: tuple[AddCommand, ...] = (_add_demo, _add_reproduce, add_zoo)


def main(argv: Sequence[str] | None = None, prog: str = "sb3-knntd", commands: Sequence[AddCommand] = COMMANDS) -> int:
    """
    :param argv: arguments of the command line, without the program's name; by default those it was called with
    :param prog: the program's name
    :param commands: the commands it has
    :return: exit code
    :raises SystemExit: with code 2 after a mistake of the user's, with 0 after ``--help`` and ``--version``
    """
    parser = Parser(prog=prog, description="kNN-TD(λ) for Stable-Baselines3: a table at k nearest points, no network.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('sb3-knntd')}")
    subparsers = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND", required=True)
    for add_command in commands:
        add_command(subparsers)
    args = parser.parse_args(argv)
    try:
        exit_code: int = args.run(args)
    except CommandError as error:
        subparsers.choices[args.command].error(str(error))
    except KeyboardInterrupt:
        print("\nInterrupted.", file=sys.stderr)
        return INTERRUPTED
    return exit_code
