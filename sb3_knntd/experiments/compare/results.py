"""The results of a comparison, and statistics that need no resampling."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_knntd.experiments.compare.configurations import FLOOR, Configuration


class Run(NamedTuple):
    """
    The result of one run.

    :param env: id of the environment
    :param algo: name of the algorithm
    :param seed: seed of the run
    :param result: return value of :func:`sb3_knntd.experiments.compare.run.run`
    """

    env: str
    algo: str
    seed: int
    result: Mapping[str, Any]

    @property
    def final_return(self) -> float:
        """Mean return of the last evaluation."""
        return float(self.result["returns"][-1])

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of learning."""
        return float(self.result["steps"][-1] / self.result["seconds"][-1])

    @property
    def cpu_share(self) -> float:
        """CPU time divided by wall-clock time of learning; less than 1 on a busy machine."""
        return float(self.result["cpu_seconds"] / self.result["seconds"][-1])

    def cost_to(self, threshold: float) -> tuple[float, float]:
        """
        :param threshold: mean return
        :return: steps and seconds of learning until the first evaluation that reached it, infinite if none did
        """
        for steps, seconds, mean in zip(
            self.result["steps"], self.result["seconds"], self.result["returns"], strict=True
        ):
            if mean >= threshold:
                return float(steps), float(seconds)
        return math.inf, math.inf


class Task(NamedTuple):
    """
    An environment and its runs.

    :param env: id of the environment
    :param runs: by algorithm, one run per seed; at least one for each algorithm
    :param threshold: mean return that counts as solved, ``None`` if unknown
    """

    env: str
    runs: Mapping[str, Sequence[Run]]
    threshold: float | None

    def returns(self, algo: str) -> np.ndarray:
        """
        :param algo: name of an algorithm
        :return: mean returns, shape (n_runs, n_points)
        """
        return np.array([run.result["returns"] for run in self.runs[algo]])

    def seconds(self, algo: str) -> np.ndarray:
        """
        :param algo: name of an algorithm
        :return: seconds of learning at each point, shape (n_runs, n_points)
        """
        return np.array([run.result["seconds"] for run in self.runs[algo]])

    def steps(self) -> np.ndarray:
        """
        :return: environment steps at each evaluation point, shape (n_points,)
        """
        return np.array(self.runs[FLOOR][0].result["steps"])

    @property
    def floor(self) -> float:
        """Mean return of random actions, which has a normalised score of 0."""
        return float(self.returns(FLOOR).mean())

    @property
    def top(self) -> float:
        """Return with a normalised score of 1: the threshold, or without one the best final mean return."""
        best = max(float(self.returns(algo)[:, -1].mean()) for algo in self.runs)
        return self.threshold if self.threshold is not None and self.threshold > self.floor else best

    def scores(self, algo: str) -> np.ndarray:
        """
        :param algo: name of an algorithm
        :return: normalised mean returns, shape (n_runs, n_points)
        """
        span = self.top - self.floor
        # If no algorithm is better than random actions, all scores are 0.
        return (self.returns(algo) - self.floor) / span if span > 0 else np.zeros_like(self.returns(algo))


class Group(NamedTuple):
    """
    Environments on which the same algorithms were run, so that their scores can be aggregated.

    :param tasks: the environments and their runs
    :param algos: names of the algorithms
    """

    tasks: Sequence[Task]
    algos: Sequence[str]

    def scores(self, algo: str) -> np.ndarray:
        """
        :param algo: name of an algorithm
        :return: normalised scores of the seeds that finished on every environment, shape (n_runs, n_tasks, n_points)
        """
        by_seed = [
            {run.seed: scores for run, scores in zip(task.runs[algo], task.scores(algo), strict=True)}
            for task in self.tasks
        ]
        seeds = sorted(set.intersection(*(set(scores) for scores in by_seed)))
        return np.array([[scores[seed] for scores in by_seed] for seed in seeds])


def make_groups(tasks: Sequence[Task]) -> list[Group]:
    """
    :param tasks: environments and their runs
    :return: the tasks grouped by their algorithms
    """
    algos = {task.env: tuple(task.runs) for task in tasks}
    return [Group([task for task in tasks if algos[task.env] == same], same) for same in dict.fromkeys(algos.values())]


class Comparison(NamedTuple):
    """
    The content of a report.

    :param tasks: environments and their runs
    :param groups: the tasks grouped by their algorithms
    :param configurations: configurations by environment and algorithm
    :param command: the command line that reproduces the results
    :param seeds: seeds of the runs
    :param steps: environment steps per run
    :param eval_points: evaluations per run
    :param eval_episodes: episodes per evaluation
    :param failures: error messages by name of the failed run
    :param notes: further notes for the reader
    """

    tasks: Sequence[Task]
    groups: Sequence[Group]
    configurations: Mapping[tuple[str, str], Configuration]
    command: str
    seeds: Sequence[int]
    steps: int
    eval_points: int
    eval_episodes: int
    failures: Mapping[str, str]
    notes: Sequence[str]
