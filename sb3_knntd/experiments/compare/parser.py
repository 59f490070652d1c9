"""The parser of ``sb3-knntd compare``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_knntd.common.command_line import (
    CommandError,
    add_seeds,
    chosen_seeds,
    positive_float,
    positive_int,
    require,
    run_resumable,
)
from sb3_knntd.registry import Algorithm, Role, with_role

if TYPE_CHECKING:
    from sb3_knntd.common.command_line import Subparsers


def add_compare(subparsers: Subparsers) -> None:
    """
    :param subparsers: where to add the command
    """
    known = with_role(Role.OWN, Role.BASELINE).values()
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
        help=f"{', '.join(map(_help_of, known))}, and RL Zoo's: dqn, qrdqn, ppo, sac, td3, ...",
    )
    add_seeds(parser, 10, "configurations of this package were tuned on seeds below 1000")
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
    parser.set_defaults(run=_run)


def _help_of(algorithm: Algorithm) -> str:
    return f"{algorithm.name} ({algorithm.description})" if algorithm.description else algorithm.name


def _run(args: argparse.Namespace) -> int:
    require("rl_zoo3", "rliable", "jinja2", "matplotlib", "tqdm", extra="compare")
    if args.backend == "ray":
        require("ray", extra="ray")
    from sb3_knntd.experiments.compare.command import Plan, compare

    plan = Plan(
        list(dict.fromkeys(args.env)),
        list(dict.fromkeys(args.algos)),
        chosen_seeds(args),
        args.steps,
        args.defaults,
        {name: Path(path) for name, path in _pairs("--conf", args.conf, "NAME=FILE")},
        _thresholds(args.threshold, args.env),
        args.eval_points,
        args.eval_episodes,
        args.gym_packages,
        args.out,
    )
    return run_resumable(
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
