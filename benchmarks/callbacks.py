"""
The overhead of callbacks at their default frequency, as a share of the time of training without callbacks.

    python -m benchmarks.callbacks [--seconds 120] [--repeats 7] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
from sb3_knntd.callbacks import (
    EpisodeVideoCallback,
    HParamCallback,
    PerceptionStatsCallback,
    TableCheckpointCallback,
    ValueMapCallback,
)
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from benchmarks.machine import describe
from sb3_knntd import KNNTD
from sb3_knntd.common.callback_dispatcher import CallbackDispatcher

ENV_ID = "MountainCar-v0"
TOGETHER = "all five"
#: Number of steps over which the time of a step is measured.
STEPS = 20_000


class MinimalCallback(BaseCallback):
    """A callback that does nothing."""

    def _on_step(self) -> bool:
        return True


class Row(NamedTuple):
    """
    One line of the table.

    :param name: name of the callback
    :param call: microseconds of a call at a step at which it has nothing to do
    :param call_share: the same as a share of a step without callbacks
    :param act: mean seconds of its occasional work; ``None`` if there was none
    :param act_share: share of the time spent on that work, without the one at the end of training
    """

    name: str
    call: float
    call_share: float
    act: float | None
    act_share: float


def make_callbacks(folder: Path) -> dict[str, BaseCallback]:
    """
    :param folder: output folder
    :return: the package's callbacks with their default arguments, by name
    """
    return {
        "ValueMapCallback": ValueMapCallback(),
        "PerceptionStatsCallback": PerceptionStatsCallback(),
        "TableCheckpointCallback": TableCheckpointCallback(folder / "checkpoints"),
        "EpisodeVideoCallback": EpisodeVideoCallback(gym.make(ENV_ID, render_mode="rgb_array")),
        "HParamCallback": HParamCallback(),
    }


def make_model(folder: Path) -> KNNTD:
    """
    :param folder: folder of TensorBoard's log
    """
    return KNNTD(ENV_ID, seed=0, tensorboard_log=str(folder))


def step_seconds(repeats: int) -> float:
    """
    :param repeats: number of measurements; the minimum is returned, because other load only adds time
    :return: CPU seconds of a step without callbacks
    """
    model = KNNTD(ENV_ID, seed=0)
    times = []
    for _ in range(repeats + 1):
        start = time.process_time()
        model.learn(STEPS)
        times.append((time.process_time() - start) / STEPS)
    return min(times[1:])


def call_seconds(callback: BaseCallback, folder: Path, repeats: int) -> float:
    """
    :param callback: a callback
    :param folder: folder of TensorBoard's log
    :param repeats: number of measurements; the minimum is returned
    :return: CPU seconds of a call when the callback has nothing to do
    """
    seen: dict[str, Any] = {}

    def see(local: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.update(local)
        return True

    model = make_model(folder)
    # Stop in the middle of an episode.
    model.learn(150, callback=see)
    callback.init_callback(model)
    callback.on_training_start(seen, {})
    for each in getattr(callback, "callbacks", [callback]):
        if hasattr(each, "_act"):
            each._act = lambda: None
    dispatcher, observations = CallbackDispatcher(callback), seen["new_obs"]
    times = []
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(STEPS):
            # The algorithm's calls in one step.
            for listener in dispatcher.every_step:
                listener.on_rollout_start()
            if dispatcher.record_step(observations, False):
                dispatcher.dispatch(dict(seen), model.num_timesteps, False)
            for listener in dispatcher.every_step:
                listener.on_rollout_end()
        times.append((time.process_time() - start) / STEPS)
    return min(times)


class Watch:
    """
    Measures the occasional work of a callback.

    :param act: the callback's ``_act``
    """

    def __init__(self, act: Callable[[], None]) -> None:
        self._act = act
        self.seconds: list[float] = []

    def __call__(self) -> None:
        start = time.perf_counter()
        self._act()
        self.seconds.append(time.perf_counter() - start)


class Deadline(BaseCallback):
    """
    Stops training after a given time.

    :param seconds: duration of the training
    """

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds

    def _on_training_start(self) -> None:
        self.start = time.perf_counter()

    def _on_step(self) -> bool:
        self.lasted = time.perf_counter() - self.start
        return self.lasted < self.seconds


def acts(folder: Path, seconds: float) -> tuple[dict[str, list[float]], float]:
    """
    Train with all callbacks together.

    :param folder: output folder
    :param seconds: duration of the training
    :return: seconds of each callback's work, without the last one, and the total time
    """
    callbacks, deadline, watches = make_callbacks(folder), Deadline(seconds), {}
    for name, callback in callbacks.items():
        if hasattr(callback, "_act"):
            watches[name] = callback._act = Watch(callback._act)
    make_model(folder).learn(10**12, callback=CallbackList([*callbacks.values(), deadline]))
    return {name: watch.seconds[:-1] for name, watch in watches.items()}, deadline.lasted


def measure(seconds: float, repeats: int) -> tuple[float, list[Row]]:
    """
    :param seconds: duration of the training with all callbacks
    :param repeats: number of repeated short measurements
    :return: seconds of a step without callbacks, and the lines of the table
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        step = step_seconds(repeats)
        acted, lasted = acts(folder / "together", seconds)
        nobody = call_seconds(CallbackList([]), folder, repeats)
        all_together = CallbackList([*make_callbacks(folder).values()])
        rows = []
        for each, callback in {
            "a minimal SB3 callback": MinimalCallback(),
            **make_callbacks(folder),
            TOGETHER: all_together,
        }.items():
            call = call_seconds(callback, folder, repeats) - nobody
            spent = [*chain(*acted.values())] if each == TOGETHER else acted.get(each, [])
            act = statistics.mean(spent) if spent and each != TOGETHER else None
            rows.append(Row(each, 1e6 * call, call / step, act, sum(spent) / lasted))
        return step, rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0, help="duration of the training with all callbacks")
    parser.add_argument("--repeats", type=int, default=7, help="number of repeated short measurements")
    parser.add_argument("--json", metavar="FILE", help="also store the table")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    step, rows = measure(arguments.seconds, arguments.repeats)
    print("| callback | call, µs | calls, % of a step | act, ms | acts, % of the time | total, % |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        act = "" if row.act is None else f"{1e3 * row.act:.0f}"
        print(
            f"| {row.name} | {row.call:.2f} | {100 * row.call_share:.1f} | {act} | {100 * row.act_share:.2f} "
            f"| {100 * (row.call_share + row.act_share):.1f} |"
        )
    print(f"\n{ENV_ID}, a step of {1e6 * step:.1f} µs; {arguments.seconds:g} s of learning with all callbacks.")
    print(", ".join(f"{key} {value}" for key, value in describe().items()))
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump({"machine": describe(), "step": step, "rows": [row._asdict() for row in rows]}, file)


if __name__ == "__main__":
    main()
