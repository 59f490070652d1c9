"""Shared by the commands of ``sb3-knntd``: the parser, types of arguments, and error handling."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    import gymnasium as gym

    # argparse's own class is generic only in type stubs.
    Subparsers = argparse._SubParsersAction["Parser"]
    AddCommand = Callable[[Subparsers], None]

#: Exit code after Ctrl-C, the shell's own for it.
INTERRUPTED = 130


class CommandError(Exception):
    """A command cannot be carried out. The user sees only the message, without a traceback."""


class Parser(argparse.ArgumentParser):
    """Reports errors in one line, without argparse's usage, which would hide the reason."""

    def error(self, message: str) -> NoReturn:
        """
        :param message: what is wrong
        :raises SystemExit: with code 2, always
        """
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}\n")


def reason_of(error: Exception) -> str:
    """
    :param error: an exception
    :return: its message; preceded by its type, unless the type is one whose messages are meant for users
    """
    from gymnasium.error import Error

    text = str(error)
    is_plain = isinstance(error, (ValueError, OSError, ImportError, AssertionError, Error))
    return text if is_plain and text else f"{type(error).__name__}: {text}"


def make_env(env_id: str) -> gym.Env[Any, Any]:
    """
    :param env_id: gymnasium id
    :return: the environment
    :raises CommandError: if making it raises any exception
    """
    import gymnasium as gym

    try:
        return gym.make(env_id)
    except Exception as error:
        raise CommandError(f"--env: {env_id!r} cannot be made: {reason_of(error)}") from error


def positive_int(text: str) -> int:
    """
    :param text: argument of the command line
    :return: its value
    :raises argparse.ArgumentTypeError: if it is no integer, or less than 1
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
    :return: its value
    :raises argparse.ArgumentTypeError: if it is no integer in [0, 2³¹)
    """
    try:
        number = int(text)
    except ValueError:
        number = -1
    if not 0 <= number < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 2147483647; got {text!r}")
    return number


def positive_float(text: str) -> float:
    """
    :param text: argument of the command line
    :return: its value
    :raises argparse.ArgumentTypeError: if it is no number, infinite, or not above 0
    """
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not (isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"must be a number above 0; got {text!r}")
    return number


def add_seeds(parser: argparse.ArgumentParser, default: int, first_seed_help: str) -> None:
    parser.add_argument(
        "--seeds", type=positive_int, default=default, metavar="N", help="number of seeds (default: %(default)s)"
    )
    parser.add_argument(
        "--first-seed", type=seed_int, default=1000, metavar="N", help=f"{first_seed_help} (default: %(default)s)"
    )


def chosen_seeds(args: argparse.Namespace) -> range:
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    if seeds[-1] >= 2**31:
        raise CommandError(f"seeds go to 2147483647; got {args.seeds} from {args.first_seed} on")
    return seeds


def run_resumable(command: Callable[[], int], out: Path) -> int:
    """
    Run a command, and tell the user how to resume it if it is interrupted.

    :param command: stores finished results in ``out``
    :param out: folder of the results
    :return: its exit code, or :data:`INTERRUPTED`
    """
    try:
        return command()
    except KeyboardInterrupt:
        print(f"\nInterrupted. Finished results are in {out}: the same command goes on from there.", file=sys.stderr)
        return INTERRUPTED


def require(*modules: str, extra: str = "extra") -> None:
    """
    :param modules: modules that the command needs
    :param extra: the extra of this package that installs them
    :raises CommandError: if some of them are not installed
    """
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise CommandError(f'{" and ".join(missing)} not installed: pip install "sb3-knntd[{extra}]"')


def run_commands(commands: Sequence[AddCommand], argv: Sequence[str] | None = None, prog: str = "sb3-knntd") -> int:
    """
    Parse the command line and run the command.

    :param commands: functions that each add one or more commands: a subparser, whose default ``run`` is the function
        that runs the command and returns its exit code
    :param argv: arguments of the command line, without the program's name; by default those of this process
    :param prog: the program's name
    :return: exit code
    :raises SystemExit: with code 2 if the user made a mistake, with 0 after ``--help`` and ``--version``
    """
    parser = Parser(prog=prog, description="kNN-TD(λ) for Stable-Baselines3: a table at k nearest points, no network.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('sb3-knntd')}")
    parser.add_argument("--traceback", action="store_true", help="show the traceback of an error, not only its message")
    subparsers = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND", required=True)
    for add_command in commands:
        add_command(subparsers)
    args = parser.parse_args(argv)
    try:
        exit_code: int = args.run(args)
    except CommandError as error:
        if args.traceback:
            raise
        subparsers.choices[args.command].error(str(error))
    except KeyboardInterrupt:
        print("\nInterrupted.", file=sys.stderr)
        return INTERRUPTED
    return exit_code
