"""
Returns after training, as distributions over seeds: with default settings, with tuned settings, with points that grow,
and with many parallel environments. And, on request, the number of steps until a threshold is reached.

    python -m benchmarks.learning [--seeds N] [--first-seed 100] [--only TABLE ...] [--json FILE]
    python -m benchmarks.learning --only dyna [--env ID ...] [--workers N] [--runs FOLDER] [--json FILE]
    python -m benchmarks.learning --only rivals [--env ID ...] [--workers N] [--runs FOLDER] [--json FILE]

Each seed trains a model and evaluates it over 100 greedy episodes in a separate environment. A line shows the median of
the mean returns over the seeds, with the 10 % and 90 % quantiles.

The tables "dyna" and "rivals" are explained in ``benchmarks/sample_efficiency.py``. The result of each of their runs is
kept in the folder as soon as it is there, and computed again only if its configuration changes: after a change of the
algorithms themselves, use another folder. They need the extra ``[compare]``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from benchmarks import sample_efficiency
from benchmarks.machine import describe
from sb3_knntd.registry import ALGORITHMS
from sb3_knntd.zoo.schedules import with_schedules

EPISODES = 100


class Case(NamedTuple):
    """
    One line of a table.

    :param what: name of the setting
    :param env_id: id of the environment
    :param steps: number of training steps, of all environments together
    :param target: required median, ``None`` for no requirement
    :param n_envs: number of parallel environments
    :param tuned: whether to use the settings of ``zoo_configs/``
    :param algorithm: name of an algorithm of this package
    :param settings: arguments of the algorithm besides these
    """

    what: str
    env_id: str
    steps: int
    target: float | None = None
    n_envs: int = 1
    tuned: bool = False
    algorithm: str = "knntd"
    settings: dict[str, Any] | None = None


TABLES = {
    "untuned": [
        Case("KNNTD(id)", "MountainCar-v0", 50_000, -130),
        Case("KNNTD(id)", "CartPole-v1", 50_000, 400),
        Case("KNNTD(id)", "Acrobot-v1", 50_000, -120),
    ],
    "tuned": [Case("tuned", "MountainCar-v0", 20_000, -110, tuned=True)],
    "continuous": [
        Case("ExA(id)", "Pendulum-v1", 50_000, algorithm="exa"),
        Case("ExA(id)", "MountainCarContinuous-v0", 20_000, algorithm="exa"),
        Case("tuned", "Pendulum-v1", 50_000, -200, tuned=True, algorithm="exa"),
        Case("tuned", "MountainCarContinuous-v0", 10_000, 94, tuned=True, algorithm="exa"),
    ],
    "grow": [
        Case(what, env_id, 20_000, algorithm=algorithm, settings=settings)
        for env_id, algorithm, n_dims, spacing in (
            ("MountainCar-v0", "knntd", 2, 0.06),
            ("CartPole-v1", "knntd", 4, 0.18),
            ("Acrobot-v1", "knntd", 6, 0.3),
            ("Pendulum-v1", "exa", 3, 0.12),
            ("MountainCarContinuous-v0", "exa", 2, 0.06),
        )
        for what, settings in (
            ("lattice", {}),
            ("points that grow", {"points": "grow"}),
            (
                "and Gaussian weights",
                {
                    "points": "grow",
                    "weights": "gaussian",
                    "bandwidth": 2 * spacing,
                    "n_neighbors": 4 * n_dims + 1,
                },
            ),
        )
    ],
    "envs": [
        Case("1 environment", "MountainCar-v0", 200_000),
        Case("8 environments", "MountainCar-v0", 200_000, n_envs=8),
        Case("64 environments", "MountainCar-v0", 200_000, n_envs=64),
    ],
}


def tuned_settings(algorithm: str, env_id: str) -> dict[str, Any]:
    """
    :param algorithm: name of an algorithm of this package
    :param env_id: id of the environment
    :return: the algorithm's arguments in ``zoo_configs/``, with schedules as functions
    """
    path = ALGORITHMS[algorithm].config_path
    assert path is not None
    settings = yaml.safe_load(path.read_text(encoding="utf-8"))[env_id]
    return with_schedules({name: value for name, value in settings.items() if name not in ("n_timesteps", "policy")})


def play(case: Case, seed: int) -> float:
    """
    :param case: what to train and evaluate
    :param seed: seed of the model and its environments
    :return: mean return of the greedy policy
    """
    th.set_num_threads(1)
    settings = tuned_settings(case.algorithm, case.env_id) if case.tuned else {}
    venv = make_vec_env(case.env_id, case.n_envs, seed=seed)
    model = ALGORITHMS[case.algorithm].load()(venv, seed=seed, **settings, **(case.settings or {}))
    model.learn(case.steps)
    evaluation = make_vec_env(case.env_id, 10, seed=10_000 + seed)
    mean, _ = evaluate_policy(model, evaluation, n_eval_episodes=EPISODES, deterministic=True)
    assert isinstance(mean, float)
    return mean


def returns_table(names: Sequence[str], seeds: Sequence[int]) -> list[dict[str, Any]]:
    """
    Print returns after training.

    :param names: names in :data:`TABLES`
    :param seeds: one training per seed
    :return: what is stored
    """
    stored = []
    print(
        "| setting | environment | steps | median return | 10 % to 90 % | must reach | |\n|---|---|---|---|---|---|---|"
    )
    with ProcessPoolExecutor() as pool:
        for name in names:
            for case in TABLES[name]:
                returns = list(pool.map(play, [case] * len(seeds), seeds))
                low, median, high = np.quantile(returns, (0.1, 0.5, 0.9))
                verdict = "" if case.target is None else "yes" if median >= case.target else "no"
                print(
                    f"| {case.what} | {case.env_id} | {case.steps:,} | {median:.1f} | {low:.1f} to {high:.1f} "
                    f"| {'' if case.target is None else f'>= {case.target:g}'} | {verdict} |",
                    flush=True,
                )
                stored.append({**case._asdict(), "seeds": list(seeds), "returns": returns})
    return stored


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    others, env_ids = sample_efficiency.TABLES, list(sample_efficiency.TASKS)
    parser.add_argument("--seeds", type=int, help="number of seeds, by default 10, and 3 of rivals")
    parser.add_argument("--first-seed", type=int, default=100, help="seeds 100 to 109 were not used for tuning")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=[*TABLES, *others],
        metavar="TABLE",
        help=f"{', '.join(TABLES)}, which are the default; {', '.join(others)}",
    )
    parser.add_argument("--env", nargs="+", choices=env_ids, metavar="ID", help=f"of {' and '.join(others)}")
    parser.add_argument("--workers", type=int, help=f"number of processes of {' and '.join(others)}")
    parser.add_argument("--runs", type=Path, default=Path("logs/learning"), help="folder of their finished runs")
    parser.add_argument("--json", metavar="FILE", help="also store the result of every seed")
    arguments = parser.parse_args()

    def seeds(usual: int) -> range:
        return range(arguments.first_seed, arguments.first_seed + (arguments.seeds or usual))

    names = arguments.only or list(TABLES)
    stored: dict[str, Any] = {"machine": describe()}
    if of_returns := [name for name in names if name in TABLES]:
        stored["cases"] = returns_table(of_returns, seeds(10))
        print(f"\nSeeds {seeds(10)[0]} to {seeds(10)[-1]}, {EPISODES} greedy episodes each. ", end="")
    for name in names:
        if name in others:
            table, usual = others[name]
            stored[name] = table(seeds(usual), arguments.runs, arguments.workers, arguments.env or env_ids)
            print(f"\nSeeds {seeds(usual)[0]} to {seeds(usual)[-1]}. ", end="")
    print(", ".join(f"{key} {value}" for key, value in stored["machine"].items()))
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(stored, file, indent=1)


if __name__ == "__main__":
    main()
