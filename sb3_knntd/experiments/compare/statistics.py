"""Point estimates and 95 % intervals over seeds, by rliable's stratified bootstrap (Agarwal et al., NeurIPS 2021)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from rliable import library, metrics
from scipy.stats import trim_mean

from sb3_knntd.experiments.compare.configurations import is_own
from sb3_knntd.experiments.compare.results import Group, Task

#: Number of bootstrap resamples.
REPETITIONS = 2000
#: Bytes in a megabyte and in a kilobyte.
MB, KB = 1e6, 1e3
#: With fewer seeds, intervals are unreliable.
FEWEST_SEEDS = 5

#: Aggregates of the final scores, by name.
AGGREGATES: dict[str, Callable[[np.ndarray], float]] = {
    "IQM": metrics.aggregate_iqm,
    "median": metrics.aggregate_median,
    "optimality gap": metrics.aggregate_optimality_gap,
}


class Estimate(NamedTuple):
    """
    Point estimates with their intervals, arrays of the same shape.

    :param value: point estimates
    :param low: lower bounds
    :param high: upper bounds
    """

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


@contextmanager
def fixed_seed() -> Iterator[None]:
    """Seed NumPy's global generator, which rliable uses, so that the intervals are reproducible."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)


def estimate(scores: Mapping[str, np.ndarray], function: Callable[[np.ndarray], np.ndarray]) -> dict[str, Estimate]:
    """
    :param scores: scores by algorithm, shape (n_runs, n_tasks, ...)
    :param function: statistic that maps scores of that shape to shape (n,)
    :return: the statistic and its interval by algorithm, shape (n,)
    """
    with fixed_seed():
        values, intervals = library.get_interval_estimates(dict(scores), function, reps=REPETITIONS)
    return {algo: Estimate(values[algo], *intervals[algo]) for algo in scores}


def curves(scores: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """
    :param scores: scores by algorithm, shape (n_runs, n_tasks, n_points)
    :return: the interquartile mean at each point by algorithm, shape (n_points,)
    """
    return estimate(scores, _iqm_by_point)


def _iqm_by_point(scores: np.ndarray) -> np.ndarray:
    # A vectorised metrics.aggregate_iqm.
    return np.asarray(trim_mean(scores.reshape(-1, scores.shape[-1]), 0.25, axis=0))


def aggregates(scores: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """
    :param scores: final scores by algorithm, shape (n_runs, n_tasks)
    :return: the values of :data:`AGGREGATES` by algorithm, in their order
    """
    return estimate(scores, lambda drawn: np.array([function(drawn) for function in AGGREGATES.values()]))


def profiles(scores: Mapping[str, np.ndarray], thresholds: np.ndarray) -> dict[str, Estimate]:
    """
    :param scores: final scores by algorithm, shape (n_runs, n_tasks)
    :param thresholds: scores, shape (n,)
    :return: the share of runs with a score above each threshold by algorithm, shape (n,)
    """
    with fixed_seed():
        values, intervals = library.create_performance_profile(dict(scores), thresholds, reps=REPETITIONS)
    return {algo: Estimate(values[algo], *intervals[algo]) for algo in scores}


def improvements(scores: Mapping[str, np.ndarray], firsts: Sequence[str]) -> dict[tuple[str, str], Estimate]:
    """
    :param scores: final scores by algorithm, shape (n_runs, n_tasks)
    :param firsts: the algorithms to compare with all others
    :return: by pair of algorithms, the probability that a run of the first has a higher score than a run of the second
        (ties count half), averaged over environments, shape (1,)
    """
    pairs = {
        (first, second): [scores[first], scores[second]] for first in firsts for second in scores if second != first
    }
    if not pairs:
        return {}
    with fixed_seed():
        values, intervals = library.get_interval_estimates(
            {f"{first},{second}": drawn for (first, second), drawn in pairs.items()},
            lambda first, second: np.array([_probability_of_improvement(first, second)]),
            reps=REPETITIONS,
        )
    return {pair: Estimate(values[",".join(pair)], *intervals[",".join(pair)]) for pair in pairs}


def _probability_of_improvement(first: np.ndarray, second: np.ndarray) -> float:
    # Like metrics.probability_of_improvement, without its rank test.
    differences = first[:, None, :] - second[None, :, :]
    return float(((differences > 0) + 0.5 * (differences == 0)).mean())


def task_rows(task: Task) -> list[dict[str, Any]]:
    """
    :param task: an environment and its runs
    :return: one row of statistics per algorithm, medians over seeds unless the name says otherwise
    """
    final = curves({algo: task.returns(algo)[:, None, -1:] for algo in task.runs})
    mean = curves({algo: task.returns(algo).mean(axis=1)[:, None, None] for algo in task.runs})
    rows = []
    for algo, runs in task.runs.items():
        costs = [run.cost_to(task.threshold) if task.threshold is not None else (math.nan,) * 2 for run in runs]
        rows.append(
            {
                "env": task.env,
                "algo": algo,
                "runs": len(runs),
                "final_iqm": final[algo].value.item(),
                "final_low": final[algo].low.item(),
                "final_high": final[algo].high.item(),
                "final_median": float(np.median([run.final_return for run in runs])),
                "mean_iqm": mean[algo].value.item(),
                "threshold": task.threshold,
                "reached": sum(math.isfinite(steps) for steps, _ in costs),
                "steps_to_threshold": median(steps for steps, _ in costs),
                "seconds_to_threshold": median(seconds for _, seconds in costs),
                "steps_per_second": median(run.steps_per_second for run in runs),
                "cpu_share": median(run.cpu_share for run in runs),
                "start_seconds": median(run.result["start_seconds"] for run in runs),
                "peak_memory_mb": median(run.result["peak_memory"] / MB for run in runs),
                "learning_memory_mb": median(
                    (run.result["peak_memory"] - run.result["base_memory"]) / MB for run in runs
                ),
                "model_kb": median(run.result["model_size"] / KB for run in runs),
            }
        )
    return rows


class GroupStatistics(NamedTuple):
    """
    Statistics over several environments, of final scores unless stated otherwise.

    :param aggregates: aggregates by algorithm
    :param thresholds: scores at which the profiles are evaluated, shape (n,)
    :param profiles: performance profiles by algorithm
    :param improvements: probabilities of improvement by pair of algorithms
    :param shares: evaluation points as shares of the training, shape (n_points,)
    :param curves: interquartile mean of the scores during training by algorithm
    """

    aggregates: Mapping[str, Estimate]
    thresholds: np.ndarray
    profiles: Mapping[str, Estimate]
    improvements: Mapping[tuple[str, str], Estimate]
    shares: np.ndarray
    curves: Mapping[str, Estimate]


def group_statistics(group: Group) -> GroupStatistics:
    """
    :param group: environments with the same algorithms
    :return: statistics over all of them
    """
    scores = {algo: drawn for algo in group.algos if len(drawn := group.scores(algo))}
    final = {algo: drawn[..., -1] for algo, drawn in scores.items()}
    lowest = min(0.0, min(float(drawn.min()) for drawn in final.values()))
    highest = max(1.0, max(float(drawn.max()) for drawn in final.values()))
    thresholds = np.linspace(max(lowest, -1.0), highest * 1.02, 121)
    firsts = [algo for algo in final if is_own(algo)] or list(final)[:1]
    n_points = next(iter(scores.values())).shape[-1]
    return GroupStatistics(
        aggregates(final),
        thresholds,
        profiles(final, thresholds),
        improvements(final, firsts),
        np.arange(1, n_points + 1) / n_points,
        curves(scores),
    )
