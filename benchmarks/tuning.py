"""
Retrain the best trials of a study and the present configuration with several seeds.

    python -m benchmarks.tuning --algo knntd --env Acrobot-v1 --storage studies/acrobot.log --study-name acrobot
                                [--best N] [--seeds N] [--first-seed 50] [--episodes N] [--workers N] [--runs FOLDER]

A study judges a trial by the last evaluation of a single training. This script rounds the values of the best trials to
two digits and trains them like ``python -m benchmarks.zoo``, which also lists the requirements. It prints the
configuration with the best mean. Seeds 100 to 109 are reserved for reporting.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import yaml

from benchmarks.zoo import EPISODES, configurations, jobs
from sb3_knntd.distributed.jobs import Job, run_jobs
from sb3_knntd.registry import ALGORITHMS, Role, with_role
from sb3_knntd.zoo import register

#: Name of the row for the configuration in ``zoo_configs/``.
PRESENT = "present"


def rounded(values: Mapping[str, Any], digits: int) -> dict[str, Any]:
    """
    :param values: values of any type
    :param digits: number of significant digits of floats
    :return: the values with rounded floats
    """
    return {key: float(f"{value:.{digits}g}") if isinstance(value, float) else value for key, value in values.items()}


def candidates(algo: str, configuration: Mapping[str, Any], study: optuna.Study, best: int) -> dict[str, Any]:
    """
    :param algo: name of the algorithm
    :param configuration: configuration of the environment
    :param study: study on that environment
    :param best: number of best trials
    :return: configurations by name: ``"present"``, and the best trials by their numbers
    """
    done = study.get_trials(states=[optuna.trial.TrialState.COMPLETE])
    done = sorted((trial for trial in done if math.isfinite(trial.values[0])), key=lambda trial: -trial.values[0])
    convert = ALGORITHMS[algo].load_search_space().convert
    found = {
        str(trial.number): {**configuration, **rounded(convert(rounded(trial.params, 2)), 4)} for trial in done[:best]
    }
    return {PRESENT: dict(configuration), **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", choices=with_role(Role.OWN), required=True)
    parser.add_argument("--env", required=True, metavar="ID", help="an environment with a configuration")
    parser.add_argument("--storage", required=True, help="storage of the study: a .log file or a database")
    parser.add_argument("--study-name", required=True)
    parser.add_argument("--best", type=int, default=5, help="number of trials")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds for each")
    parser.add_argument("--first-seed", type=int, default=50)
    parser.add_argument(
        "--episodes",
        type=int,
        default=EPISODES,
        help="episodes per evaluation; a few are enough for a fixed initial state",
    )
    parser.add_argument("--workers", type=int, help="number of processes, by default one per core")
    parser.add_argument("--runs", type=Path, default=Path("logs/tuning"), help="folder of the finished runs")
    arguments = parser.parse_args()
    algo, env_id = arguments.algo, arguments.env
    if (algo, env_id) not in configurations():
        there = ", ".join(known for other, known in configurations() if other == algo)
        parser.error(f"--env: {algo} has no configuration for {env_id}, only for {there}")

    storage = arguments.storage
    if storage.endswith(".log"):
        storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(storage))
    register()
    study = optuna.load_study(study_name=arguments.study_name, storage=storage)
    tried = candidates(algo, configurations()[algo, env_id], study, arguments.best)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    wanted = {
        name: [
            Job(f"{name}-{job.key}", job.function, {**job.arguments, "episodes": arguments.episodes})
            for job in jobs(algo, env_id, settings, seeds)
        ]
        for name, settings in tried.items()
    }
    runs = arguments.runs / arguments.study_name
    outcomes = run_jobs([job for some in wanted.values() for job in some], runs, arguments.workers, "tuning")

    means = {}
    print("| trial | in the study | mean | lowest seed | highest seed | std over episodes |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, some in wanted.items():
        if any(outcomes[job.key].error for job in some):
            print(f"| {name} | failed | | | | |")
            continue
        returns = np.array([outcomes[job.key].result["returns"] for job in some])
        means[name] = float(returns.mean())
        value = "" if name == PRESENT else f"{study.trials[int(name)].value:.2f}"
        by_seed = np.sort(returns.mean(axis=1))
        figures = " | ".join(f"{figure:.2f}" for figure in (means[name], by_seed[0], by_seed[-1], returns.std()))
        print(f"| {name} | {value} | {figures} |")
    best = max(means, key=lambda name: means[name])
    print(f"\nBest: {best}\n")
    print(yaml.safe_dump({env_id: tried[best]}, sort_keys=False, default_flow_style=None))


if __name__ == "__main__":
    main()
