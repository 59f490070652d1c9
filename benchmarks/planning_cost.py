"""
The cost of KNNDyna's planning as transitions accumulate.

    python -m benchmarks.planning_cost [--sizes 10000 50000 100000] [--env ID ...] [--json FILE]

An agent with the default settings learns for as many steps as the largest number of transitions, and some more, in
which a full buffer drops some. At each size the table shows milliseconds per environment step, means over the next
2,000 steps: of planning by the clock, and of CPU time of everything with the environment; and the longest CPU time of
one step since the last size. Other work on the machine makes the first of them too high.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.machine import describe
from sb3_knntd.dyna import KNNDyna

ENV_IDS = ("Pendulum-v1", "CartPole-v1")
SIZES = (10_000, 50_000, 100_000)
#: Number of steps that means are over.
WINDOW = 2_000
#: Number of steps of another model before the measurement, so that everything is compiled.
WARM_UP = 1_000
#: Required mean of planning, and required longest step, seconds.
MEAN_LIMIT, LONGEST_LIMIT = 1e-3, 0.5


class Cost(NamedTuple):
    """
    The cost at a size.

    :param size: number of transitions
    :param planning: mean seconds of planning per step
    :param step: mean seconds of CPU time per step, of everything
    :param longest: the longest step since the last size, seconds of CPU time
    :param longest_wall: the same in wall-clock time
    """

    size: int
    planning: float
    step: float
    longest: float
    longest_wall: float


class Stopwatch(BaseCallback):
    """
    Measures the time of the steps.

    :param sizes: numbers of steps after which to measure, rising
    :param window: number of steps that means are over
    """

    def __init__(self, sizes: Sequence[int], window: int) -> None:
        super().__init__()
        self._sizes, self._window = list(sizes), window
        self.costs: list[Cost] = []
        self._longest = self._longest_wall = self._begun = 0.0

    def _on_training_start(self) -> None:
        self._last, self._last_wall = time.process_time(), time.perf_counter()

    def _on_step(self) -> bool:
        now, wall = time.process_time(), time.perf_counter()
        self._longest = max(self._longest, now - self._last)
        self._longest_wall = max(self._longest_wall, wall - self._last_wall)
        size = self._sizes[len(self.costs)]
        if self.num_timesteps == size:
            # The learner's summary is of the steps since the last one.
            self._planning_time()
            self._begun = now
        elif self.num_timesteps == size + self._window:
            step = (now - self._begun) / self._window
            self.costs.append(Cost(size, self._planning_time(), step, self._longest, self._longest_wall))
            self._longest = self._longest_wall = 0.0
        self._last, self._last_wall = time.process_time(), time.perf_counter()
        return len(self.costs) < len(self._sizes)

    def _planning_time(self) -> float:
        assert isinstance(self.model, KNNDyna)
        return self.model.learner.summary()["planning_time"]


def measure(env_id: str, sizes: Sequence[int], window: int = WINDOW) -> list[Cost]:
    """
    :param env_id: id of the environment
    :param sizes: numbers of transitions, rising, further apart than ``window``
    :param window: number of steps that means are over
    :return: the cost at each size
    """
    th.set_num_threads(1)
    KNNDyna(env_id, seed=1, buffer_size=WARM_UP // 2).learn(WARM_UP)
    stopwatch = Stopwatch(sizes, window)
    # Logging would read the summary.
    KNNDyna(env_id, seed=0).learn(sizes[-1] + window, callback=stopwatch, log_interval=None)
    return stopwatch.costs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES, help="numbers of transitions")
    parser.add_argument("--env", nargs="+", default=ENV_IDS, metavar="ID", help="environments")
    parser.add_argument("--json", metavar="FILE", help="also store the results")
    arguments = parser.parse_args()
    sizes = sorted(set(arguments.sizes))
    if any(after - before <= WINDOW for before, after in zip([0, *sizes], sizes, strict=False)):
        parser.error(f"--sizes must be more than {WINDOW:,} apart, from 0 on; got {sizes}")
    print(
        "| environment | transitions | planning, ms | step, ms | longest step, ms | within limits |\n"
        + "|---" * 6
        + "|"
    )
    stored: dict[str, Any] = {"machine": describe()}
    for env_id in arguments.env:
        costs = measure(env_id, sizes)
        for cost in costs:
            within = cost.planning <= MEAN_LIMIT and cost.longest <= LONGEST_LIMIT
            print(
                f"| {env_id} | {cost.size:,} | {1e3 * cost.planning:.2f} | {1e3 * cost.step:.2f} "
                f"| {1e3 * cost.longest:.0f} | {'yes' if within else 'no'} |",
                flush=True,
            )
        stored[env_id] = [cost._asdict() for cost in costs]
    limits = f"Limits: a mean of planning of {1e3 * MEAN_LIMIT:g} ms, a longest step of {1e3 * LONGEST_LIMIT:g} ms."
    print(f"\n{limits} " + ", ".join(f"{key} {value}" for key, value in stored["machine"].items()))
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(stored, file, indent=1)


if __name__ == "__main__":
    main()
