"""The command ``sb3-knntd``."""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from sb3_knntd.zoo import SCRIPTS
from sb3_knntd.zoo import run as run_script

if TYPE_CHECKING:
    import gymnasium as gym

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


def reason_of(error: Exception) -> str:
    """
    :param error: what was raised
    :return: what it says; with its type, unless it was written for users to read
    """
    from gymnasium.error import Error

    text = str(error)
    is_plain = isinstance(error, (ValueError, OSError, ImportError, AssertionError, Error))
    return text if is_plain and text else f"{type(error).__name__}: {text}"


def make_env(env_id: str) -> gym.Env[Any, Any]:
    """
    :param env_id: gymnasium id
    :return: the environment
    :raises CommandError: if it cannot be made, whatever it raises
    """
    import gymnasium as gym

    try:
        return gym.make(env_id)
    except Exception as error:
        raise CommandError(f"--env: {env_id!r} cannot be made: {reason_of(error)}") from error


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


def positive_float(text: str) -> float:
    """
    :param text: argument of the command line
    :return: the number it is
    :raises argparse.ArgumentTypeError: if it is none, infinite, or not above 0
    """
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not (isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"must be a number above 0; got {text!r}")
    return number


def _add_seeds(parser: argparse.ArgumentParser, default: int, first_seed_help: str) -> None:
    parser.add_argument(
        "--seeds", type=positive_int, default=default, metavar="N", help="number of seeds (default: %(default)s)"
    )
    parser.add_argument(
        "--first-seed", type=seed_int, default=1000, metavar="N", help=f"{first_seed_help} (default: %(default)s)"
    )


def _seeds(args: argparse.Namespace) -> range:
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    if seeds[-1] >= 2**31:
        raise CommandError(f"seeds go to 2147483647; got {args.seeds} from {args.first_seed} on")
    return seeds


def _resumable(command: Callable[[], int], out: Path) -> int:
    """
    :param command: keeps what is finished
    :param out: where
    :return: its exit code, or that of an interruption, of which the user is told
    """
    try:
        return command()
    except KeyboardInterrupt:
        print(f"\nInterrupted. What is finished is in {out}: the same command goes on from there.", file=sys.stderr)
        return INTERRUPTED


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
        description="Train KNNTD, or ExA where actions are continuous, on an environment, save and reload the model, "
        "evaluate it beside a random policy, and draw its learning curve and value function.",
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
    from sb3_knntd.experiments.demo import demo

    return 0 if demo(args.env, args.steps, args.seed, args.out) else INTERRUPTED


def _add_reproduce(subparsers: Subparsers) -> None:
    from sb3_knntd.experiments.reproduce import FIGURES

    parser = subparsers.add_parser(
        "reproduce",
        help="compute a figure of the paper over many seeds",
        description="Compute a figure of the paper over many seeds, and write a table (CSV), a picture (PNG) and a "
        "verdict, the paper's numbers beside ours. What is interrupted goes on where it was.",
    )
    figures = "; ".join(f"{name}: {figure.help}" for name, figure in FIGURES.items())
    parser.add_argument("figure", choices=FIGURES, metavar="FIGURE", help=figures)
    parser.add_argument("--best", action="store_true", help="this project's best settings, not the paper's")
    _add_seeds(parser, 30, "the best settings were tuned on seeds below 1000")
    parser.add_argument("--episodes", type=positive_int, metavar="N", help="episodes of each seed")
    parser.add_argument("--workers", type=positive_int, metavar="N", help="processes (default: one a core)")
    parser.add_argument(
        "--out", type=Path, default=Path("results"), metavar="DIR", help="folder for all files (default: %(default)s)"
    )
    parser.set_defaults(run=_run_reproduce)


def _run_reproduce(args: argparse.Namespace) -> int:
    require("tqdm", "matplotlib", "yaml")
    from sb3_knntd.experiments.reproduce.command import reproduce

    seeds = _seeds(args)
    return _resumable(lambda: reproduce(args.figure, args.best, seeds, args.episodes, args.out, args.workers), args.out)


def _add_compare(subparsers: Subparsers) -> None:
    parser = subparsers.add_parser(
        "compare",
        help="compare algorithms over seeds, with statistics and a report",
        description="Run every algorithm on every environment whose actions it can take, with every seed, and write a "
        "report: one HTML page, and the CSV, JSON and PNG files behind it. Acting at random is always among them. What "
        "is interrupted goes on where it was, and more seeds, algorithms or environments use the runs that are there.",
    )
    parser.add_argument("--env", nargs="+", required=True, metavar="ID", help="gymnasium ids")
    parser.add_argument(
        "--algos",
        nargs="+",
        required=True,
        metavar="NAME",
        help="knntd, exa, sarsa (true online SARSA(λ) with tile coding), and RL Zoo's: dqn, qrdqn, ppo, sac, td3, ...",
    )
    _add_seeds(parser, 10, "configurations of this package were tuned on seeds below 1000")
    parser.add_argument(
        "--steps",
        type=positive_int,
        default=50_000,
        metavar="N",
        help="environment steps of each run (default: %(default)s)",
    )
    parser.add_argument(
        "--defaults",
        action="store_true",
        help="each algorithm's own defaults, not RL Zoo's and this package's tuned ones",
    )
    parser.add_argument(
        "--conf",
        nargs="+",
        default=[],
        metavar="NAME=FILE",
        help="take an algorithm's configurations from a file in RL Zoo's form",
    )
    parser.add_argument(
        "--threshold",
        nargs="+",
        default=[],
        metavar="[ID=]RETURN",
        help="mean return that counts as having learned an environment (default: its reward_threshold)",
    )
    parser.add_argument(
        "--eval-points", type=positive_int, default=40, metavar="N", help="evaluations a run (default: %(default)s)"
    )
    parser.add_argument(
        "--eval-episodes",
        type=positive_int,
        default=20,
        metavar="N",
        help="greedy episodes an evaluation (default: %(default)s)",
    )
    parser.add_argument(
        "--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules that register further environments"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("results"), metavar="DIR", help="folder for all files (default: %(default)s)"
    )
    where = parser.add_argument_group("where it is computed, which results do not depend on")
    where.add_argument(
        "--backend", choices=("local", "ray"), default="local", help="this machine, or a Ray cluster (default: local)"
    )
    where.add_argument("--workers", type=positive_int, metavar="N", help="local: processes (default: one a core)")
    where.add_argument(
        "--address",
        metavar="ADDRESS",
        help="ray: auto for the cluster of this machine, ray://HOST:PORT for one elsewhere (default: RAY_ADDRESS, or "
        "else a cluster of this machine alone)",
    )
    where.add_argument(
        "--cpus-per-run", type=positive_float, default=1.0, metavar="N", help="ray: CPUs to reserve (default: 1)"
    )
    where.add_argument(
        "--memory-per-run", type=positive_float, metavar="GIB", help="ray: memory to reserve (default: none)"
    )
    parser.set_defaults(run=_run_compare)


def _run_compare(args: argparse.Namespace) -> int:
    require("rl_zoo3", "rliable", "jinja2", "matplotlib", "tqdm", extra="compare")
    if args.backend == "ray":
        require("ray", extra="ray")
    from sb3_knntd.experiments.compare.command import Plan, compare

    plan = Plan(
        list(dict.fromkeys(args.env)),
        list(dict.fromkeys(args.algos)),
        _seeds(args),
        args.steps,
        args.defaults,
        {name: Path(path) for name, path in _pairs("--conf", args.conf, "NAME=FILE")},
        _thresholds(args.threshold, args.env),
        args.eval_points,
        args.eval_episodes,
        args.gym_packages,
        args.out,
    )
    return _resumable(
        lambda: compare(plan, args.backend, args.workers, args.address, args.cpus_per_run, args.memory_per_run),
        args.out,
    )


def _pairs(option: str, texts: Sequence[str], form: str) -> list[tuple[str, str]]:
    pairs = []
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise CommandError(f"{option} must be {form}; got {text!r}")
        pairs.append((name, value))
    return pairs


def _thresholds(texts: Sequence[str], envs: Sequence[str]) -> dict[str, float]:
    if len(texts) == 1 and "=" not in texts[0]:
        if len(set(envs)) > 1:
            raise CommandError(f"--threshold must be ID=RETURN where there are several environments; got {texts[0]!r}")
        texts = [f"{envs[0]}={texts[0]}"]
    try:
        thresholds = {env: float(value) for env, value in _pairs("--threshold", texts, "ID=RETURN")}
    except ValueError as error:
        raise CommandError(f"--threshold: {error}") from error
    if not all(map(isfinite, thresholds.values())):
        raise CommandError(f"--threshold must be finite; got {' '.join(texts)}")
    return thresholds


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
        run_script(args.command, args.arguments)
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


#: Each adds one command or several: the parser, and with ``set_defaults(run=...)`` the function that runs it and
#: returns the exit code.
COMMANDS: tuple[AddCommand, ...] = (_add_demo, _add_reproduce, _add_compare, add_zoo)


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
    parser.add_argument("--traceback", action="store_true", help="show where an error came from, not its reason alone")
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
