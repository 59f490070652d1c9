"""
The time of a step of environments in separate processes: SB3's SubprocVecEnv and RayVecEnv, both on this machine.

    python -m benchmarks.ray_vec_env [--n-envs 2] [--repeats 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import ray
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from benchmarks.machine import describe
from sb3_knntd.distributed.ray_vec_env import RayVecEnv


class Slow(gym.Env[np.ndarray, Any]):
    """
    An environment whose steps only wait.

    :param seconds: duration of a step
    """

    def __init__(self, seconds: float) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.render_mode = None
        self.seconds = seconds

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self.seconds:
            time.sleep(self.seconds)
        return np.zeros(4, np.float32), 0.0, False, False, {}


class Row(NamedTuple):
    """
    One line of the table.

    :param seconds: duration of a step of one environment
    :param subproc: milliseconds of a step of all environments in a SubprocVecEnv, median of the repeats
    :param ray: the same for a RayVecEnv
    """

    seconds: float
    subproc: float
    ray: float


def step_milliseconds(venv: VecEnv, seconds: float) -> float:
    """
    :param venv: the environments
    :param seconds: duration of the measurement
    :return: milliseconds of a step of all environments
    """
    actions = np.zeros(venv.num_envs, np.int64)
    n_steps, start = 0, time.perf_counter()
    while (lasted := time.perf_counter() - start) < seconds:
        venv.step(actions)
        n_steps += 1
    return 1e3 * lasted / n_steps


def measure(step_seconds: float, n_envs: int, repeats: int) -> Row:
    """
    :param step_seconds: duration of a step of one environment
    :param n_envs: number of environments
    :param repeats: number of alternating measurements of both, after one warm-up
    """
    makers = [partial(Slow, step_seconds)] * n_envs
    venvs = [SubprocVecEnv(makers), RayVecEnv(makers, num_cpus=0)]
    for venv in venvs:
        venv.reset()
    times = [[step_milliseconds(venv, 1.0) for venv in venvs] for _ in range(repeats + 1)][1:]
    for venv in venvs:
        venv.close()
    return Row(step_seconds, *map(statistics.median, zip(*times, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-envs", type=int, default=2, help="number of environments")
    parser.add_argument("--repeats", type=int, default=5, help="number of measurements")
    parser.add_argument("--json", metavar="FILE", help="also store the table")
    arguments = parser.parse_args()
    rows = [measure(seconds, arguments.n_envs, arguments.repeats) for seconds in (0.0, 0.01)]
    print("| step of one environment, ms | SubprocVecEnv, ms | RayVecEnv, ms |")
    print("|---|---|---|")
    for row in rows:
        print(f"| {1e3 * row.seconds:g} | {row.subproc:.2f} | {row.ray:.2f} |")
    machine = describe() | {"ray": ray.__version__}
    print(f"\n{arguments.n_envs} environments.")
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump({"machine": machine, "n_envs": arguments.n_envs, "rows": [row._asdict() for row in rows]}, file)


if __name__ == "__main__":
    main()
