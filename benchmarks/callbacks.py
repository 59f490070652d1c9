"""
What callbacks cost at their default frequency, as a share of the time that learning takes without any.

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
TOGETHER = "all five together"
#: Steps that a time of a step is taken over.
STEPS = 20_000


class Nothing(BaseCallback):
    """SB3's least callback."""

    def _on_step(self) -> bool:
        return True


class Row(NamedTuple):
    """
    One line of the table.

    :param name: of the callback
    :param call: microseconds that it takes to tell it of a step at which it has nothing to do
    :param call_share: the same as a share of a step without callbacks
    :param act: seconds of one act, the mean; ``None`` for callbacks without any
    :param act_share: share of the time spent on acting, but for the one at the end of training
    """

    name: str
    call: float
    call_share: float
    act: float | None
    act_share: float


def make_callbacks(folder: Path) -> dict[str, BaseCallback]:
    """
    :param folder: where files go
    :return: each of the package's callbacks, with its defaults
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
    :param folder: where TensorBoard's log goes
    """
    return KNNTD(ENV_ID, seed=0, tensorboard_log=str(folder))


def step_seconds(repeats: int) -> float:
    """
    :param repeats: the best of so many, since what else the machine does only adds
    :return: seconds of the processor that a step without callbacks takes
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
    :param callback: any
    :param folder: where TensorBoard's log goes
    :param repeats: the best of so many
    :return: seconds of the processor that it takes to tell it of a step, when it has nothing to do
    """
    seen: dict[str, Any] = {}

    def see(local: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.update(local)
        return True

    model = make_model(folder)
    # Ends within an episode.
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
            # What the algorithm does about its callbacks in a step.
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
    Times what a callback does now and then.

    :param act: its ``_act``
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
    Ends training, and notes when.

    :param seconds: how long it is to last
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
    Learn with all callbacks together.

    :param folder: where files go
    :param seconds: for how long
    :return: seconds of each callback's acts, but for the last, and how long it took in all
    """
    callbacks, deadline, watches = make_callbacks(folder), Deadline(seconds), {}
    for name, callback in callbacks.items():
        if hasattr(callback, "_act"):
            watches[name] = callback._act = Watch(callback._act)
    make_model(folder).learn(10**12, callback=CallbackList([*callbacks.values(), deadline]))
    return {name: watch.seconds[:-1] for name, watch in watches.items()}, deadline.lasted


def measure(seconds: float, repeats: int) -> tuple[float, list[Row]]:
    """
    :param seconds: how long to learn with all callbacks
    :param repeats: how often short times are taken
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
            "SB3's least callback": Nothing(),
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
    parser.add_argument("--seconds", type=float, default=120.0, help="how long to learn with all callbacks")
    parser.add_argument("--repeats", type=int, default=7, help="how often short times are taken")
    parser.add_argument("--json", metavar="FILE", help="also store the table")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    step, rows = measure(arguments.seconds, arguments.repeats)
    print("| callback | call, µs | calls, % of a step | act, ms | acts, % of the time | together, % |")
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
