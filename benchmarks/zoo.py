"""
Results of the configurations in ``zoo_configs/``, compared with RL Zoo's published results.

    python -m benchmarks.zoo [--env ID ...] [--seeds N [ID=N ...]] [--first-seed 100] [--workers N] [--runs FOLDER]
                             [--json FILE] [--markdown FILE]

For each environment of the configuration files and each seed the script trains an agent like ``sb3-knntd train``
and evaluates it over 100 greedy episodes in separate environments. Finished runs are kept in the folder and repeated
only if their configuration changes; after a change of the algorithms themselves, use another folder. Failures, such as
a missing simulator, are reported at the end. All environments need
``pip install "gymnasium[box2d,mujoco,toy-text]"``.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_wrapper

from benchmarks.machine import describe
from sb3_knntd import VecDeltaFilter
from sb3_knntd.common.files import replace_file
from sb3_knntd.distributed.jobs import Job, run_jobs, stored_as
from sb3_knntd.registry import Role, with_role
from sb3_knntd.zoo import register
from sb3_knntd.zoo.experiment import KNNExperimentManager

EPISODES, EVALUATION_ENVS = 100, 10
#: Added to the seeds of evaluation environments.
EVALUATION_SEED = 10_000
#: Step limit of evaluation episodes in environments without one, in which a policy may move in circles.
MOST_STEPS = 1000

#: Source of RL Zoo's results.
SOURCE = "https://github.com/DLR-RM/rl-baselines3-zoo/blob/0088472b8cb622732bdbc4aa3d0d0abde86c67ed/benchmark.md"


class Published(NamedTuple):
    """
    A line of RL Zoo's table, the result of one run.

    :param algo: name of the algorithm
    :param env_id: id of the environment, in the version of that time
    :param mean_reward: mean return
    :param std_reward: standard deviation over episodes
    :param n_timesteps: number of training steps
    """

    algo: str
    env_id: str
    mean_reward: float
    std_reward: float
    n_timesteps: int


PUBLISHED = (
    Published("dqn", "MountainCar-v0", -100.849, 9.925, 120_000),
    Published("qrdqn", "MountainCar-v0", -106.042, 15.536, 120_000),
    Published("ppo", "MountainCar-v0", -110.423, 19.473, 1_000_000),
    Published("dqn", "CartPole-v1", 500.0, 0.0, 50_000),
    Published("qrdqn", "CartPole-v1", 500.0, 0.0, 50_000),
    Published("ppo", "CartPole-v1", 500.0, 0.0, 100_000),
    Published("dqn", "Acrobot-v1", -76.639, 11.752, 100_000),
    Published("qrdqn", "Acrobot-v1", -69.135, 9.967, 100_000),
    Published("ppo", "Acrobot-v1", -73.506, 18.201, 1_000_000),
    Published("dqn", "LunarLander-v2", 154.382, 79.241, 100_000),
    Published("qrdqn", "LunarLander-v2", 70.236, 225.491, 100_000),
    Published("ppo", "LunarLander-v2", 242.119, 31.823, 1_000_000),
    Published("ppo", "Pendulum-v1", -172.225, 104.159, 100_000),
    Published("sac", "Pendulum-v1", -156.995, 88.714, 20_000),
    Published("ppo", "MountainCarContinuous-v0", 88.343, 2.572, 20_000),
    Published("sac", "MountainCarContinuous-v0", 94.679, 1.134, 50_000),
    Published("tqc", "MountainCarContinuous-v0", 63.641, 45.259, 50_000),
    Published("ppo", "LunarLanderContinuous-v2", 270.863, 32.072, 1_000_000),
    Published("sac", "LunarLanderContinuous-v2", 260.390, 65.467, 500_000),
    Published("tqc", "LunarLanderContinuous-v2", 277.956, 25.466, 500_000),
)


class Row(NamedTuple):
    """
    The results on one environment.

    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param n_timesteps: number of training steps
    :param seeds: seeds of the runs
    :param returns: return of each episode, shape (n_seeds, n_episodes)
    :param seconds: duration of each training
    """

    algo: str
    env_id: str
    n_timesteps: int
    seeds: list[int]
    returns: list[list[float]]
    seconds: list[float]


def configurations() -> dict[tuple[str, str], dict[str, Any]]:
    """
    :return: the configurations in ``zoo_configs/`` by algorithm and environment
    """
    paths = {name: algorithm.config_path for name, algorithm in with_role(Role.OWN).items()}
    stored = {algo: yaml.safe_load(path.read_text(encoding="utf-8")) for algo, path in paths.items() if path}
    return {
        (algo, env_id): settings
        for algo, by_env in stored.items()
        for env_id, settings in by_env.items()
        if env_id != "default"
    }


# Run by ``python -m`` it was stored under the other name.
@stored_as("benchmarks.zoo.play", "__main__.play")
def play(algo: str, env_id: str, settings: Mapping[str, Any], seed: int, episodes: int) -> dict[str, Any]:
    """
    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param settings: configuration in RL Zoo's format
    :param seed: seed of the training; evaluation uses another
    :param episodes: number of greedy evaluation episodes
    :return: the ``"returns"`` of the episodes, and the training time in ``"seconds"``
    """
    register()
    with TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        config = Path(folder, "config.yml")
        config.write_text(yaml.safe_dump({env_id: dict(settings)}))
        set_random_seed(seed)
        manager = KNNExperimentManager(
            argparse.Namespace(), algo, env_id, folder, eval_freq=-1, seed=seed, log_interval=-2, config=str(config)
        )
        model, _ = manager.setup_experiment()  # type: ignore[misc]
        evaluation = _evaluation_envs(manager, model, EVALUATION_SEED + seed)
        start = time.perf_counter()
        manager.learn(model)
        seconds = time.perf_counter() - start
        returns, _ = evaluate_policy(model, evaluation, episodes, deterministic=True, return_episode_rewards=True)
        evaluation.close()
    return {"returns": returns, "seconds": seconds}


def _evaluation_envs(manager: KNNExperimentManager, model: BaseAlgorithm, seed: int) -> VecEnv:
    """Evaluation environments with the wrappers of the training environments, and the frozen filter if there is one."""
    assert model.env is not None
    manager.seed, manager.eval_env_kwargs = seed, manager.env_kwargs
    if gym.spec(manager.env_name.gym_id).max_episode_steps is None:
        manager.eval_env_kwargs = {"max_episode_steps": MOST_STEPS} | manager.env_kwargs
    learned_filter = unwrap_vec_wrapper(model.env, VecDeltaFilter)
    if learned_filter is not None:
        manager.vec_env_wrapper = learned_filter.for_evaluation
    return manager.create_envs(EVALUATION_ENVS, eval_env=True)


def jobs(algo: str, env_id: str, settings: Mapping[str, Any], seeds: Sequence[int]) -> list[Job]:
    """
    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param settings: configuration
    :param seeds: one seed per job
    :return: the jobs
    """
    name = env_id.replace("/", "-")
    arguments = {"algo": algo, "env_id": env_id, "settings": settings, "episodes": EPISODES}
    return [Job(f"{algo}-{name}-{seed}", play, arguments | {"seed": seed}) for seed in seeds]


def summary(row: Row) -> dict[str, Any]:
    """
    :param row: results on one environment
    :return: their summary, with lists in the order of the seeds
    """
    return {
        "algo": row.algo,
        "env_id": row.env_id,
        "n_timesteps": row.n_timesteps,
        "eval_episodes": int(np.size(row.returns)),
        "seeds": row.seeds,
        "mean_reward": np.mean(row.returns, axis=1).tolist(),
        "std_reward": np.std(row.returns, axis=1).tolist(),
        "seconds": row.seconds,
    }


def line(row: Row) -> list[str]:
    """
    :param row: results on one environment
    :return: cells of their line in the table
    """
    low, median, high = np.quantile(np.mean(row.returns, axis=1), (0.1, 0.5, 0.9))
    return [
        f"**{row.algo}**",
        row.env_id,
        f"{np.mean(row.returns):.2f}",
        f"{np.std(row.returns):.2f}",
        f"{median:.2f} [{low:.2f}, {high:.2f}]",
        steps(row.n_timesteps),
        str(len(row.seeds)),
        str(np.size(row.returns)),
        f"{statistics.median(row.seconds):.3g} s",
    ]


def published_line(figure: Published) -> list[str]:
    """
    :param figure: a result of RL Zoo
    :return: cells of its line in the table
    """
    reward = [f"{figure.mean_reward:.2f}", f"{figure.std_reward:.2f}"]
    return [figure.algo, figure.env_id, *reward, "", steps(figure.n_timesteps), "1", "", ""]


def steps(number: int) -> str:
    """
    :param number: number of steps
    :return: the number in RL Zoo's format, such as ``20k`` or ``1M``
    """
    return f"{number / 1e6:g}M" if number >= 1_000_000 else f"{number / 1e3:g}k"


def table(rows: Sequence[Row]) -> str:
    """
    :param rows: the results
    :return: Markdown table, in which RL Zoo's results on any version of an environment follow those of this package
    """
    names = ["algo", "env_id", "mean_reward", "std_reward", "median [10 %, 90 %]"]
    names += ["n_timesteps", "seeds", "eval_episodes", "training"]
    lines = [names, ["---", "---", *["---:"] * 7]]
    for row in rows:
        lines.append(line(row))
        name = row.env_id.rpartition("-")[0]
        lines += [published_line(figure) for figure in PUBLISHED if figure.env_id.rpartition("-")[0] == name]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def page(rows: Sequence[Row], command: str) -> str:
    """
    :param rows: the results
    :param command: the command that computed them
    :return: page in Markdown
    """
    machine = ", ".join(f"{key} {value}" for key, value in describe().items())
    first, last = min(min(row.seeds) for row in rows), max(max(row.seeds) for row in rows)
    return f"""# Benchmark

Results of the configurations in `zoo_configs/knntd.yml` and `exa.yml`, in the format of RL Zoo's benchmark.
`mean_reward` and `std_reward` are over all greedy episodes of all seeds, {EPISODES} per seed. `median` is the median
over the seeds of the mean return of a seed, with the 10 % and 90 % quantiles. `training` is the median wall-clock time
of one training. The seeds are {first} to {last}, none of which were used for tuning.

Lines with one seed and no time are RL Zoo's results from its
[benchmark.md]({SOURCE}),
one run each. They show what can be reached, on the environment versions of that time, which can differ slightly from
the current ones. Environments without such a line have no published result.

{table(rows)}

Computed by

```bash
pip install ".[zoo]" "gymnasium[box2d,mujoco,toy-text]"
{command}
```

on {machine}.
"""


def seeds_of(words: Sequence[str]) -> tuple[int, dict[str, int]]:
    """
    :param words: a number of seeds, and exceptions as ``ID=N``
    :return: the number, and the exceptions by environment
    :raises ValueError: if a word is invalid, or a number is below 1
    """
    number, exceptions = 10, {}
    for word in words:
        env_id, equals, count = word.rpartition("=")
        if not count.isdecimal() or int(count) < 1 or (equals and not env_id):
            raise ValueError(f"--seeds takes a number >= 1 or ID=NUMBER; got {word!r}")
        if equals:
            exceptions[env_id] = int(count)
        else:
            number = int(count)
    return number, exceptions


def learn(
    seeds: Mapping[tuple[str, str], Sequence[int]], runs: Path, workers: int | None
) -> tuple[list[Row], dict[str, str]]:
    """
    :param seeds: seeds by algorithm and environment
    :param runs: folder of the finished runs
    :param workers: number of processes; by default one per core
    :return: the results, and the errors by job
    """
    known = configurations()
    wanted = {(algo, env_id): jobs(algo, env_id, known[algo, env_id], some) for (algo, env_id), some in seeds.items()}
    outcomes = run_jobs([job for some in wanted.values() for job in some], runs, workers, "benchmark")
    rows = []
    for (algo, env_id), some in wanted.items():
        done = [(job, outcomes[job.key].result) for job in some if not outcomes[job.key].error]
        if done:
            rows.append(
                Row(
                    algo,
                    env_id,
                    int(known[algo, env_id]["n_timesteps"]),
                    [job.arguments["seed"] for job, _ in done],
                    [result["returns"] for _, result in done],
                    [result["seconds"] for _, result in done],
                )
            )
    return rows, {key: outcome.error for key, outcome in outcomes.items() if outcome.error}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = configurations()
    env_ids = list(dict.fromkeys(env_id for _, env_id in known))
    parser.add_argument("--env", nargs="+", choices=env_ids, metavar="ID", help=", ".join(env_ids))
    parser.add_argument("--seeds", nargs="+", default=["10"], metavar="N", help="number of seeds, and exceptions: ID=N")
    parser.add_argument("--first-seed", type=int, default=100, help="seeds 100 to 109 were not used for tuning")
    parser.add_argument("--workers", type=int, help="number of processes, by default one per core")
    parser.add_argument("--runs", type=Path, default=Path("logs/benchmark"), help="folder of the finished runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also store the results of every seed")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="also write the page of the documentation")
    arguments = parser.parse_args()
    try:
        number, exceptions = seeds_of(arguments.seeds)
    except ValueError as error:
        parser.error(str(error))
    if unknown := sorted(exceptions.keys() - set(env_ids)):
        parser.error(f"--seeds: no configuration for {', '.join(unknown)}; there are {', '.join(env_ids)}")

    first = arguments.first_seed
    seeds = {
        (algo, env_id): range(first, first + exceptions.get(env_id, number))
        for algo, env_id in known
        if env_id in (arguments.env or env_ids)
    }
    register()
    rows, errors = learn(seeds, arguments.runs, arguments.workers)
    if rows:
        print(table(rows))
        if arguments.json:
            stored = {"machine": describe(), "rows": [summary(row) for row in rows]}
            replace_file(arguments.json, json.dumps(stored, indent=1).encode())
        if arguments.markdown:
            command = f"python -m benchmarks.zoo {shlex.join(sys.argv[1:])}"
            replace_file(arguments.markdown, page(rows, command).encode())
    if errors:
        sys.exit("\n".join(f"{key}: {error.strip().splitlines()[-1]}" for key, error in errors.items()))


if __name__ == "__main__":
    main()
