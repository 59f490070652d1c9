"""The results of a comparison, and the figures that need no resampling."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sb3_knntd.experiments.compare.configurations import FLOOR, Configuration


class Run(NamedTuple):
    """
    The result of one seed.

    :param env: environment
    :param algo: name of the algorithm
    :param seed: its seed
    :param result: what :func:`sb3_knntd.experiments.compare.run.run` returned
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
        """Share of the time of learning in which a core was at work for it; less than 1 on a busy machine."""
        return float(self.result["cpu_seconds"] / self.result["seconds"][-1])

    def cost_to(self, threshold: float) -> tuple[float, float]:
        """
        :param threshold: mean return
        :return: steps and seconds of learning up to the first evaluation that reached it, infinite if none did
        """
        for steps, seconds, mean in zip(
            self.result["steps"], self.result["seconds"], self.result["returns"], strict=True
        ):
            if mean >= threshold:
                return float(steps), float(seconds)
        return math.inf, math.inf


class Task(NamedTuple):
    """
    An environment, and everything that was run on it.

    :param env: environment
    :param runs: by algorithm, one a seed; no algorithm without any
    :param threshold: mean return that counts as having learned it, ``None`` if unknown
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
        :return: environment steps at each point, those of a single environment, shape (n_points,)
        """
        return np.array(self.runs[FLOOR][0].result["steps"])

    @property
    def floor(self) -> float:
        """Mean return of acting at random; a normalised score of 0."""
        return float(self.returns(FLOOR).mean())

    @property
    def top(self) -> float:
        """A normalised score of 1: the threshold, or without one the best algorithm's mean return at the end."""
        best = max(float(self.returns(algo)[:, -1].mean()) for algo in self.runs)
        return self.threshold if self.threshold is not None and self.threshold > self.floor else best

    def scores(self, algo: str) -> np.ndarray:
        """
        :param algo: name of an algorithm
        :return: mean returns, normalised, shape (n_runs, n_points)
        """
        span = self.top - self.floor
        # If no algorithm is better than acting at random, all scores are 0.
        return (self.returns(algo) - self.floor) / span if span > 0 else np.zeros_like(self.returns(algo))


class Group(NamedTuple):
    """
    Environments on which the same algorithms were run, over which averages mean something.

    :param tasks: the environments
    :param algos: names of the algorithms
    """

    tasks: Sequence[Task]
    algos: Sequence[str]

    def scores(self, algo: str) -> np.ndarray:
        """
        :param algo: name of an algorithm
        :return: normalised scores of the seeds that succeeded on every environment, shape
            (n_runs, n_tasks, n_points)
        """
        by_seed = [
            {run.seed: scores for run, scores in zip(task.runs[algo], task.scores(algo), strict=True)}
            for task in self.tasks
        ]
        seeds = sorted(set.intersection(*(set(scores) for scores in by_seed)))
        return np.array([[scores[seed] for scores in by_seed] for seed in seeds])


def make_groups(tasks: Sequence[Task]) -> list[Group]:
    """
    :param tasks: environments
    :return: the same, those with the same algorithms together
    """
    algos = {task.env: tuple(task.runs) for task in tasks}
    return [Group([task for task in tasks if algos[task.env] == same], same) for same in dict.fromkeys(algos.values())]


class Comparison(NamedTuple):
    """
    All that a report shows.

    :param tasks: environments with their runs
    :param groups: those with the same algorithms together
    :param configurations: by environment and algorithm
    :param command: the command line that computed it
    :param seeds: of the runs
    :param steps: of each run
    :param eval_points: evaluations of each run
    :param eval_episodes: episodes of each evaluation
    :param failures: by name of a failed run, its error
    :param notes: further remarks for the reader
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
