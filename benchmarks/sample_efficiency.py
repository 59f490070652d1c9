"""
The tables of ``python -m benchmarks.learning`` that count environment steps until a threshold is reached: those of
KNNDyna, and of the algorithms that are best known for few steps.

An evaluation has 20 greedy episodes in separate environments, after every 250 steps. Training ends with the first
evaluation whose mean is at the threshold. Seconds are CPU time of training without evaluation and compilation.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

import sb3_knntd.envs  # noqa: F401
from sb3_knntd.distributed.jobs import Job, Outcome, run_jobs, stored_as
from sb3_knntd.experiments.compare.configurations import configuration, label
from sb3_knntd.experiments.compare.experiment import experiment, prepare
from sb3_knntd.experiments.compare.run import WarmUp

EPISODES, CHECK_EVERY = 20, 250
#: Added to the seeds of evaluation environments.
EVALUATION_SEED = 10_000
ALGORITHM = "knndyna"
#: Default settings may need this many times the steps of tuned ones, on at least so many tasks.
DEFAULTS_FACTOR, DEFAULTS_TASKS = 2, 6

Row = dict[str, Any]


class Goal(NamedTuple):
    """
    What is to be reached.

    :param env_id: id of the environment
    :param threshold: required mean over the evaluation episodes
    :param most: the largest sum that an episode, or the rest of one, can have; not negative
    :param measure: what is summed: ``"return"``, the rewards; or a key of ``info`` whose share of an episode's largest
        number of steps counts
    """

    env_id: str
    threshold: float
    most: float
    measure: str = "return"


class Task(NamedTuple):
    """
    A line of the table, and what must be reached.

    :param goal: what is to be reached
    :param median: largest median of the steps
    :param within: number of steps within which most seeds must reach the threshold
    :param n_of_ten: the number of those seeds, out of ten
    :param row: name of the task; lines of the same name are one task
    """

    goal: Goal
    median: int
    within: int
    n_of_ten: int
    row: str

    def times(self, factor: int) -> Task:
        """
        :param factor: at least 1
        :return: the task with so many times the steps
        """
        return self._replace(median=factor * self.median, within=factor * self.within)


def task(env_id: str, threshold: float, most: float, median: int, within: int, n_of_ten: int, **rest: str) -> Task:
    """
    :param rest: ``measure`` of the goal, ``row`` of the task
    :return: the task of these parameters, see :class:`Goal` and :class:`Task`
    """
    goal = Goal(env_id, threshold, most, rest.get("measure", "return"))
    return Task(goal, median, within, n_of_ten, rest.get("row", env_id))


TASKS = {
    line.goal.env_id: line
    for line in (
        task("Pendulum-v1", -200, 0, 1_000, 2_000, 10),
        task("MountainCarContinuous-v0", 90, 100, 1_000, 2_500, 10),
        task("CartPole-v1", 475, 500, 1_500, 3_000, 9),
        task("MountainCar-v0", -110, 0, 5_000, 8_000, 9),
        task("Acrobot-v1", -100, 0, 10_000, 15_000, 8),
        task("InvertedPendulum-v5", 950, 1_000, 2_000, 2_000, 9),
        task("sb3_knntd/CartPole-v0", 8_000, 10_000, 2_500, 2_500, 8, row="the paper's cart-poles"),
        task("sb3_knntd/ContinuousCartPole-v0", 8_000, 10_000, 2_500, 2_500, 8, row="the paper's cart-poles"),
        task("sb3_knntd/CartPoleSwingUp-v0", 0.5, 1, 10_000, 10_000, 7, measure="upright"),
    )
}


class Rival(NamedTuple):
    """
    An algorithm to compare with.

    :param env_id: id of an environment of :data:`TASKS`
    :param algo: name of the algorithm
    :param limit: largest number of steps, over which schedules run
    :param hyperparams: configuration in RL Zoo's format, ``None`` for the one that ``sb3-knntd compare`` takes
    """

    env_id: str
    algo: str
    limit: int
    hyperparams: dict[str, Any] | None = None


#: SAC that takes few steps: more gradient steps for each, and a higher learning rate.
SAC = {"policy": "MlpPolicy", "learning_rate": 1e-3, "gradient_steps": 4}
CROSSQ = {"policy": "MlpPolicy"}

#: Quick ones first. Steps of those without hyperparameters here are those of docs/comparison.md.
RIVALS = (
    Rival("CartPole-v1", "knntd", 50_000),
    Rival("CartPole-v1", "ppo", 50_000),
    Rival("MountainCar-v0", "knntd", 120_000),
    Rival("Acrobot-v1", "knntd", 50_000),
    Rival("MountainCarContinuous-v0", "ppo", 20_000),
    Rival("Pendulum-v1", "sac", 4_000, SAC),
    Rival("MountainCarContinuous-v0", "sac", 4_000, SAC),
    Rival("InvertedPendulum-v5", "sac", 4_000, SAC),
    Rival("sb3_knntd/CartPole-v0", "dqn", 50_000),
    Rival("sb3_knntd/ContinuousCartPole-v0", "sac", 4_000, SAC),
    Rival("Pendulum-v1", "crossq", 4_000, CROSSQ),
    Rival("MountainCarContinuous-v0", "crossq", 4_000, CROSSQ),
    Rival("InvertedPendulum-v5", "crossq", 4_000, CROSSQ),
    Rival("sb3_knntd/ContinuousCartPole-v0", "crossq", 4_000, CROSSQ),
    Rival("sb3_knntd/CartPoleSwingUp-v0", "sac", 10_000, SAC),
    Rival("sb3_knntd/CartPoleSwingUp-v0", "crossq", 10_000, CROSSQ),
)


def evaluate(model: BaseAlgorithm, envs: VecEnv, goal: Goal, to_the_end: bool = False) -> float:
    """
    :param model: what acts, greedily
    :param envs: one environment for each episode
    :param goal: what is to be reached
    :param to_the_end: whether to finish the episodes even if the mean can no longer reach the threshold
    :return: the mean over the episodes; if they were not finished, the highest mean that was still possible
    """
    observations = envs.reset()
    sums, running = np.zeros(envs.num_envs), np.ones(envs.num_envs, dtype=np.bool_)
    n_steps = gym.spec(goal.env_id).max_episode_steps
    while running.any():
        actions, _ = model.predict(observations, deterministic=True)  # type: ignore[arg-type]
        observations, gains, dones, infos = envs.step(actions)
        if goal.measure != "return":
            gains = np.array([info[goal.measure] for info in infos]) / n_steps
        sums[running] += gains[running]
        running &= ~dones
        highest = float(np.where(running, np.minimum(sums, 0.0) + goal.most, sums).mean())
        if highest < goal.threshold and not to_the_end:
            return highest
    return float(sums.mean())


class UntilReached(BaseCallback):
    """
    Evaluates every ``CHECK_EVERY`` steps with the clock stopped, and stops training when the threshold is reached.

    :param envs: evaluation environments
    :param goal: what is to be reached
    :param limit: largest number of steps
    """

    def __init__(self, envs: VecEnv, goal: Goal, limit: int) -> None:
        super().__init__()
        self._envs, self._goal, self._limit = envs, goal, limit
        self.reached: int | None = None
        self.seconds = self.cpu_seconds = 0.0
        self._n_checks = 0

    def _on_training_start(self) -> None:
        self._start_clock()

    def _on_step(self) -> bool:
        if self.num_timesteps // CHECK_EVERY > self._n_checks:
            self._n_checks = self.num_timesteps // CHECK_EVERY
            self._stop_clock()
            training = self.model.get_env()
            assert training is not None
            sync_envs_normalization(training, self._envs)
            if evaluate(self.model, self._envs, self._goal) >= self._goal.threshold:
                self.reached = self.num_timesteps
            self._start_clock()
        return self.reached is None and self.num_timesteps < self._limit

    def _start_clock(self) -> None:
        self._since, self._cpu_since = time.perf_counter(), time.process_time()

    def _stop_clock(self) -> None:
        self.seconds += time.perf_counter() - self._since
        self.cpu_seconds += time.process_time() - self._cpu_since


@cache
def warm_up(algo: str, env_id: str, hyperparams: str) -> None:
    """
    Train another model first, once in each process, so that everything is compiled and loaded.

    :param algo: name of the algorithm
    :param env_id: id of the environment
    :param hyperparams: configuration in RL Zoo's format, as JSON
    """
    with experiment(algo, env_id, json.loads(hyperparams), 10_000, 0) as (_, model, callbacks):
        model.learn(10_000, callback=[*callbacks, WarmUp()])


@stored_as("benchmarks.sample_efficiency.train")
def train(
    goal: Mapping[str, Any], algo: str, hyperparams: dict[str, Any], limit: int, seed: int, warm: bool = True
) -> dict[str, Any]:
    """
    Train until the goal is reached.

    :param goal: the arguments of a :class:`Goal`
    :param algo: name of the algorithm
    :param hyperparams: configuration in RL Zoo's format
    :param limit: largest number of steps
    :param seed: seed of the model and its environments; those of the evaluation have another
    :param warm: whether to warm up first
    :return: ``steps`` to the threshold, ``None`` if it was not reached; ``cpu_seconds`` and ``seconds`` of training;
        ``at_end`` the mean after the last step if it was not reached
    """
    th.set_num_threads(1)
    prepare()
    wanted = Goal(**goal)
    if warm:
        warm_up(algo, wanted.env_id, json.dumps(hyperparams))
    with experiment(algo, wanted.env_id, hyperparams, limit, seed) as (manager, model, callbacks):
        manager.seed = EVALUATION_SEED + seed
        envs = manager.create_envs(EPISODES, eval_env=True)
        until = UntilReached(envs, wanted, limit)
        model.learn(limit, callback=[*callbacks, until])
        at_end = evaluate(model, envs, wanted, to_the_end=True) if until.reached is None else None
        envs.close()
    return {"steps": until.reached, "cpu_seconds": until.cpu_seconds, "seconds": until.seconds, "at_end": at_end}


def is_installed(env_id: str) -> bool:
    """
    :param env_id: id of an environment
    :return: whether it can be made; a message on standard error tells if it cannot
    """
    try:
        gym.make(env_id).close()
    except DependencyNotInstalled as error:
        print(f"{env_id} is left out: {error}", file=sys.stderr)
        return False
    return True


def jobs(goal: Goal, name: str, algo: str, hyperparams: dict[str, Any], limit: int, seeds: Sequence[int]) -> list[Job]:
    """
    :param goal: what is to be reached
    :param name: name of the configuration
    :param algo: name of the algorithm
    :param hyperparams: configuration in RL Zoo's format
    :param limit: largest number of steps
    :param seeds: one seed per job
    :return: the jobs
    """
    arguments = {"goal": goal._asdict(), "algo": algo, "hyperparams": hyperparams, "limit": limit}
    stem = f"{algo}-{name}-{goal.env_id.replace('/', '-')}"
    return [Job(f"{stem}-{seed}", train, arguments | {"seed": seed}) for seed in seeds]


def finished(wanted: Sequence[Job], outcomes: Mapping[str, Outcome]) -> list[dict[str, Any]]:
    """
    :param wanted: some jobs
    :param outcomes: outcomes by job
    :return: what the jobs computed
    :raises RuntimeError: if one has failed
    """
    for job in wanted:
        if outcomes[job.key].error:
            raise RuntimeError(f"{job.key}: {outcomes[job.key].error}")
    return [outcomes[job.key].result for job in wanted]


def shown(steps: float, limit: int) -> str:
    """
    :param steps: number of steps, infinite if the threshold was not reached
    :param limit: largest number of steps
    :return: its text
    """
    return f"{steps:,.0f}" if math.isfinite(steps) else f"> {limit:,}"


def steps_of(results: Sequence[Mapping[str, Any]]) -> list[float]:
    """
    :param results: from :func:`train`
    :return: the steps to the threshold, infinite if it was not reached
    """
    return [math.inf if result["steps"] is None else result["steps"] for result in results]


def is_met(line: Task, steps: Sequence[float]) -> bool:
    """
    :param line: what must be reached
    :param steps: steps of each seed
    :return: whether the median and the number of seeds within the limit are as required
    """
    n_within = sum(number <= line.within for number in steps)
    return statistics.median(steps) <= line.median and n_within * 10 >= line.n_of_ten * len(steps)


def dyna_table(seeds: Sequence[int], runs: Path, workers: int | None, env_ids: Sequence[str]) -> list[Row]:
    """
    Print how many steps KNNDyna takes with the settings of ``zoo_configs/`` and with its defaults.

    :param seeds: one training per seed
    :param runs: folder of the finished runs
    :param workers: number of processes, ``None`` for one per core
    :param env_ids: environments of :data:`TASKS`
    :return: what is stored
    """
    there = [env_id for env_id in env_ids if is_installed(env_id)]
    limits = {env_id: DEFAULTS_FACTOR * TASKS[env_id].within for env_id in there}
    wanted: dict[tuple[str, str], list[Job]] = {}
    for env_id in there:
        plain, own = (configuration(ALGORITHM, env_id, defaults, {}).hyperparams for defaults in (True, False))
        for table, hyperparams in (("tuned", own), ("defaults", plain)):
            name = "defaults" if hyperparams == plain else "tuned"
            wanted[table, env_id] = jobs(TASKS[env_id].goal, name, ALGORITHM, hyperparams, limits[env_id], seeds)
    # Where the settings are the defaults, both tables have the same jobs.
    unique = {job.key: job for some in wanted.values() for job in some}
    outcomes = run_jobs(list(unique.values()), runs, workers, "dyna")
    rows = []
    for table, factor in (("tuned", 1), ("defaults", DEFAULTS_FACTOR)):
        print(f"\nKNNDyna, {'settings of zoo_configs' if table == 'tuned' else 'no argument but the environment'}:\n")
        print("| task | steps, median | seeds within | CPU seconds | must reach | | by seed |")
        print("|---|---|---|---|---|---|---|")
        met: dict[str, bool] = {}
        for env_id in there:
            line, results = TASKS[env_id].times(factor), finished(wanted[table, env_id], outcomes)
            steps, limit = steps_of(results), limits[env_id]
            reached = is_met(line, steps)
            met[line.row] = met.get(line.row, True) and reached
            n_within = sum(number <= line.within for number in steps)
            print(
                f"| {env_id}, {line.goal.threshold:g} | {shown(statistics.median(steps), limit)} "
                f"| {n_within} of {len(steps)} within {line.within:,} "
                f"| {statistics.median([result['cpu_seconds'] for result in results]):.1f} "
                f"| <= {line.median:,}; {line.n_of_ten} of 10 within {line.within:,} | {'yes' if reached else 'no'} "
                f"| {' '.join(shown(number, limit) for number in steps)} |",
                flush=True,
            )
            rows.append(
                {"table": table, **line._asdict(), "goal": line.goal._asdict(), "seeds": list(seeds), "runs": results}
            )
        least = DEFAULTS_TASKS if table == "defaults" else len({line.row for line in TASKS.values()})
        print(f"\nReached on {sum(met.values())} of {len(met)} tasks; at least {least} are required.")
    return rows


def rivals_table(seeds: Sequence[int], runs: Path, workers: int | None, env_ids: Sequence[str]) -> list[Row]:
    """
    Print how many steps the rivals take.

    :param seeds: one training per seed
    :param runs: folder of the finished runs
    :param workers: number of processes, ``None`` for one per core
    :param env_ids: environments of :data:`TASKS`
    :return: what is stored
    """
    there = {env_id for env_id in env_ids if is_installed(env_id)}
    wanted: list[tuple[Rival, list[Job]]] = []
    for rival in RIVALS:
        if rival.env_id in there:
            env_id, algo, limit, given = rival
            hyperparams = given or configuration(algo, env_id, False, {}).hyperparams
            wanted.append((rival, jobs(TASKS[env_id].goal, "rival", algo, hyperparams, limit, seeds)))
    outcomes = run_jobs([job for _, some in wanted for job in some], runs, workers, "rivals")
    print("\n| task | rival | steps, median | reached | CPU seconds | by seed |\n|---|---|---|---|---|---|")
    rows = []
    for rival, some in wanted:
        results = finished(some, outcomes)
        steps = steps_of(results)
        print(
            f"| {rival.env_id}, {TASKS[rival.env_id].goal.threshold:g} | {label(rival.algo)} "
            f"| {shown(statistics.median(steps), rival.limit)} "
            f"| {sum(map(math.isfinite, steps))} of {len(steps)} within {rival.limit:,} "
            f"| {statistics.median([result['cpu_seconds'] for result in results]):.1f} "
            f"| {' '.join(shown(number, rival.limit) for number in steps)} |",
            flush=True,
        )
        rows.append({**rival._asdict(), "seeds": list(seeds), "runs": results})
    return rows


#: The tables by name, each with its usual number of seeds.
TABLES: dict[str, tuple[Callable[[Sequence[int], Path, int | None, Sequence[str]], list[Row]], int]] = {
    "dyna": (dyna_table, 10),
    "rivals": (rivals_table, 3),
}
