"""
Speed and scale, as ratios of two measurements that alternate in this process.

    python -m benchmarks.speed [--repeats 5] [--only WORD ...] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.cuda import against_copy
from benchmarks.machine import describe
from benchmarks.rows import Row
from sb3_knntd import KNNTD, ExA


class Drift(gym.Env[np.ndarray, Any]):
    """
    A random walk in a box whose steps take almost no time, so that the time of the learner dominates. The action pushes
    the first dimension. Episodes have ``length`` steps.

    :param obs_dim: number of dimensions
    :param length: steps per episode
    :param continuous: whether the action space is a Box
    """

    def __init__(self, obs_dim: int = 2, length: int = 200, continuous: bool = False) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (obs_dim,), np.float32)
        self.action_space = spaces.Box(0.0, 2.0) if continuous else spaces.Discrete(3)
        self.length = length

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps = 0
        self.moves = self.np_random.normal(0.0, 0.02, (4096, *self.observation_space.shape)).astype(np.float32)
        self.state = np.zeros(self.observation_space.shape, np.float32)
        return self.state, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        state = self.state + self.moves[self.steps % 4096]
        state[0] += 0.02 * (action.item() - 1.0)
        self.state = np.clip(state, -0.95, 0.95)
        self.steps += 1
        return self.state, -1.0, self.steps >= self.length, False, {}


def compare(
    what: str, target: str, one: Callable[[], float], other: Callable[[], float], repeats: int, unit: str
) -> Row:
    """
    :param what: name of the comparison
    :param target: required ratio ``one / other``
    :param one: the first measurement
    :param other: the second measurement
    :param repeats: number of alternating measurements of both, after one warm-up
    :param unit: unit of the measurements
    """
    one(), other()
    pairs = [(one(), other()) for _ in range(repeats)]
    ratios = [a / b for a, b in pairs]
    a, b = (statistics.median(column) for column in zip(*pairs, strict=True))
    return Row.of(what, ratios, target, f"{a:,.4g} / {b:,.4g} {unit}")


def steps_per_second(work: Callable[[int], Any], n_steps: int) -> float:
    """
    :param work: function that makes a given number of environment steps
    :param n_steps: number of steps
    """
    start = time.perf_counter()
    work(n_steps)
    return n_steps / (time.perf_counter() - start)


def bare_loop(venv: VecEnv, n_steps: int) -> None:
    """Steps with random actions, drawn beforehand, without learning."""
    random, space, size = np.random.default_rng(0), venv.action_space, (n_steps, venv.num_envs)
    if isinstance(space, spaces.Discrete):
        actions = random.integers(0, space.n, size)
    else:
        assert isinstance(space, spaces.Box)
        actions = random.uniform(space.low, space.high, (*size, *space.shape)).astype(space.dtype)
    venv.reset()
    for i in range(n_steps // venv.num_envs):
        venv.step(actions[i])


def paper_model(env: Any, points: Any = (20, 15), n_neighbors: int = 4, **arguments: Any) -> KNNTD:
    """A model with the paper's number of points and neighbours."""
    return KNNTD(env, **{"points": points, "n_neighbors": n_neighbors, "trace_decay": 0.95, "seed": 0, **arguments})


def continuous_model(env: Any, points: Any = (20, 15), n_neighbors: int = 8, **arguments: Any) -> ExA:
    """A model with eleven action points and eight neighbours, as in the paper's figure 7."""
    given = {"action_points": 11, "points": points, "n_neighbors": n_neighbors, "trace_decay": 0.95, "seed": 0}
    return ExA(env, **{**given, **arguments})


def learn_seconds(model: KNNTD | ExA, n_steps: int) -> float:
    """Microseconds per step of ``learn``."""
    return 1e6 / steps_per_second(lambda n: model.learn(n), n_steps)


def against_bare_loop(repeats: int, model: KNNTD | ExA, env_id: str, target: str) -> Row:
    venv = make_vec_env(env_id, model.n_envs, seed=0)
    # Short alternating runs, so that changes in the speed of the machine affect both.
    n_steps = 8_000
    return compare(
        f"{type(model).__name__}.learn over the bare loop, {env_id}, n_envs {model.n_envs}",
        target,
        lambda: steps_per_second(lambda n: model.learn(n), n_steps),
        lambda: steps_per_second(lambda n: bare_loop(venv, n), n_steps),
        4 * repeats,
        "steps/s",
    )


def discrete_against_bare_loop(repeats: int, n_envs: int) -> Row:
    model = paper_model(make_vec_env("MountainCar-v0", n_envs, seed=0))
    return against_bare_loop(repeats, model, "MountainCar-v0", ">= 0.75")


def continuous_against_bare_loop(repeats: int) -> Row:
    model = continuous_model(make_vec_env("Pendulum-v1", 1, seed=0), points=(9, 9, 21))
    return against_bare_loop(repeats, model, "Pendulum-v1", ">= 0.65")


def continuous_over_points(repeats: int) -> Row:
    many, few = (
        continuous_model(make_vec_env(lambda: Drift(continuous=True), 1, seed=0), points=p)
        for p in ((1000, 1000), (20, 15))
    )
    return compare(
        "ExA: a step with a lattice of 10^6 points over 300",
        "<= 1.25",
        lambda: learn_seconds(many, 16_000),
        lambda: learn_seconds(few, 16_000),
        repeats,
        "µs",
    )


def continuous_over_neighbors(repeats: int) -> Row:
    many, few = (continuous_model(make_vec_env("MountainCarContinuous-v0", 1, seed=0), n_neighbors=k) for k in (200, 4))
    return compare(
        "ExA: a step with k = 200 over k = 4",
        "<= 2.5",
        lambda: learn_seconds(many, 8_000),
        lambda: learn_seconds(few, 8_000),
        repeats,
        "µs",
    )


def against_dqn(repeats: int) -> Row:
    model = paper_model(make_vec_env("MountainCar-v0", 1, seed=0))
    dqn = DQN("MlpPolicy", make_vec_env("MountainCar-v0", 1, seed=0), device="cpu")
    return compare(
        "learn over DQN's (its defaults), MountainCar-v0",
        ">= 12",
        lambda: steps_per_second(lambda n: model.learn(n), 32_000),
        lambda: steps_per_second(lambda n: dqn.learn(n, reset_num_timesteps=False), 4_000),
        repeats,
        "steps/s",
    )


def over_points(repeats: int) -> Row:
    many, few = (paper_model(make_vec_env("MountainCar-v0", 1, seed=0), points=p) for p in ((1000, 1000), (20, 15)))
    return compare(
        "a step with a lattice of 10^6 points over 300",
        "<= 1.25",
        lambda: learn_seconds(many, 32_000),
        lambda: learn_seconds(few, 32_000),
        repeats,
        "µs",
    )


def huge_lattice(repeats: int) -> Row:
    huge = paper_model(make_vec_env(lambda: Drift(12), 1, seed=0), points=10)
    few = paper_model(make_vec_env(lambda: Drift(2), 1, seed=0))
    row = compare(
        "a step with a lattice of 10^12 points in 12 dimensions over 300 in 2",
        "<= 4",
        lambda: learn_seconds(huge, 10_000),
        lambda: learn_seconds(few, 10_000),
        repeats,
        "µs",
    )
    table = huge.policy.table
    size = table.values.element_size() * table.values.numel() / 2**20
    return row._replace(detail=f"{row.detail}; {table.n_visited:,} rows in {size:.0f} MiB")


def over_neighbors(repeats: int) -> Row:
    many, few = (paper_model(make_vec_env("MountainCar-v0", 1, seed=0), n_neighbors=k) for k in (200, 4))
    return compare(
        "a step with k = 200 over k = 4",
        "<= 2.5",
        lambda: learn_seconds(many, 16_000),
        lambda: learn_seconds(few, 16_000),
        repeats,
        "µs",
    )


class Stopwatch(BaseCallback):
    """Records the time of every thousandth step."""

    def _init_callback(self) -> None:
        self.times: list[float] = []

    def _on_step(self) -> bool:
        if self.n_calls % 1000 == 0:
            self.times.append(time.perf_counter())
        return True


def long_episode(repeats: int, continuous: bool) -> Row:
    ratios, details = [], []
    for _ in range(repeats):
        venv = make_vec_env(lambda: Drift(2, length=10**9, continuous=continuous), 1, seed=0)
        model = (continuous_model if continuous else paper_model)(venv, trace_decay=0.99, gamma=1.0)
        watch = Stopwatch()
        model.learn(100_000, callback=watch)
        thousands = np.diff(watch.times)
        # The first ten thousand steps are a warm-up; medians over five thousand steps reduce fluctuations.
        first, last = np.median(thousands[9:14]), np.median(thousands[-5:])
        ratios.append(last / first)
        details.append((last * 1e3, first * 1e3))
    last, first = (statistics.median(column) for column in zip(*details, strict=True))
    return Row.of(
        f"{'ExA: ' if continuous else ''}an episode of 10^5 steps, λ 0.99, γ 1: its last steps over its first",
        ratios,
        "<= 1.1",
        f"{last:.4g} / {first:.4g} µs",
    )


def over_scattered(repeats: int, search: str, target: str) -> Row:
    rng = np.random.default_rng(0)
    many, few = (
        paper_model(
            make_vec_env(lambda: Drift(6), 1, seed=0), rng.uniform(-1, 1, (n, 6)), n_neighbors=16, search=search
        )
        for n in (10**5, 10**3)
    )
    return compare(
        f"a step with 10^5 scattered points in 6 dimensions, k 16, over 10^3, search={search!r}",
        target,
        lambda: learn_seconds(many, 5_000),
        lambda: learn_seconds(few, 5_000),
        repeats,
        "µs",
    )


def prediction(repeats: int) -> Row:
    venv = make_vec_env("MountainCar-v0", 1, seed=0)
    model, dqn = paper_model(venv), DQN("MlpPolicy", venv, device="cpu")
    observation = venv.observation_space.sample()

    def microseconds(learner: KNNTD | DQN) -> float:
        return 1e6 / steps_per_second(
            lambda n: [learner.predict(observation, deterministic=True) for _ in range(n)], 2_000
        )

    return compare(
        "predict of one observation over DQN's",
        "<= 0.5",
        lambda: microseconds(model),
        lambda: microseconds(dqn),
        repeats,
        "µs",
    )


START_UP = """
import time
start = time.perf_counter()
import stable_baselines3, gymnasium
sb3 = time.perf_counter()
from sb3_knntd import KNNTD
KNNTD("MountainCar-v0").learn(1)
print(sb3 - start, time.perf_counter() - sb3)
"""


def start_up(repeats: int) -> Row:
    runs = []
    for _ in range(repeats + 1):
        printed = subprocess.run([sys.executable, "-c", START_UP], capture_output=True, text=True, check=True).stdout
        runs.append([float(number) for number in printed.split()])
    sb3, ours = zip(*runs[1:], strict=True)
    return Row.of(
        "import, construction and first step beyond importing SB3, seconds",
        ours,
        "<= 1",
        f"importing SB3 takes {statistics.median(sb3):.2f} s",
    )


def memory(repeats: int, dtype: th.dtype) -> Row:
    def measure() -> float:
        tracemalloc.start()
        model = paper_model(
            make_vec_env("MountainCar-v0", 1, seed=0), points=(1000, 1000), policy_kwargs={"dtype": dtype}
        )
        model.learn(20_000)
        numpy_bytes = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        table = model.policy.table
        tensor_bytes = sum(buffer.element_size() * buffer.numel() for buffer in table.buffers())
        trace_bytes = sum(array.nbytes for array in table.traces.arrays)
        assert trace_bytes < numpy_bytes
        return (tensor_bytes + trace_bytes) / (10**6 * (3 * dtype.itemsize + 4))

    ratios = [measure() for _ in range(min(repeats, 2))]
    return Row.of(
        f"table, visits and traces over n_points × (n_actions × bytes + 4), 10^6 points, {dtype}",
        ratios,
        "<= 1.1",
        "after 20,000 steps",
    )


class Pauses(BaseCallback):
    """Records the longest time between two steps."""

    def _init_callback(self) -> None:
        self.longest, self.last = 0.0, time.perf_counter()

    def _on_step(self) -> bool:
        now = time.perf_counter()
        self.longest, self.last = max(self.longest, now - self.last), now
        return True


def growth_pause(repeats: int) -> Row:
    pauses, rows = [], 0
    for _ in range(min(repeats, 2)):
        model = KNNTD(make_vec_env(lambda: Drift(12), 1, seed=0), points=30, n_neighbors=25, seed=0)
        watch = Pauses()
        model.learn(20_000, callback=watch)
        pauses.append(watch.longest)
        rows = model.policy.table.n_visited
    return Row.of(
        "longest step while a hashed table grows, seconds",
        pauses,
        "<= 0.1",
        f"{rows:,} rows at the end",
    )


def cuda(repeats: int) -> list[Row]:
    """The torch step on a GPU; empty if there is none."""
    if not th.cuda.is_available():
        print("device='cuda' is skipped: no such device", file=sys.stderr)
        return []
    return against_copy(repeats)


BENCHMARKS: dict[str, Callable[[int], Row | list[Row]]] = {
    "bare1": lambda repeats: discrete_against_bare_loop(repeats, 1),
    "bare64": lambda repeats: discrete_against_bare_loop(repeats, 64),
    "exa_bare": continuous_against_bare_loop,
    "exa_points": continuous_over_points,
    "exa_neighbors": continuous_over_neighbors,
    "exa_episode": lambda repeats: long_episode(repeats, True),
    "dqn": against_dqn,
    "points": over_points,
    "huge": huge_lattice,
    "neighbors": over_neighbors,
    "episode": lambda repeats: long_episode(repeats, False),
    "kd_tree": lambda repeats: over_scattered(repeats, "kd_tree", "<= 3"),
    "hnsw": lambda repeats: over_scattered(repeats, "hnsw", "<= 2"),
    "predict": prediction,
    "startup": start_up,
    "memory64": lambda repeats: memory(repeats, th.float64),
    "memory32": lambda repeats: memory(repeats, th.float32),
    "growth": growth_pause,
    "cuda": cuda,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5, help="number of repeated measurements")
    parser.add_argument("--only", nargs="+", choices=BENCHMARKS, metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--json", metavar="FILE", help="also store the table")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    rows = []
    print("| what | ratio | range | must reach | | figures |\n|---|---|---|---|---|---|")
    for name in arguments.only or BENCHMARKS:
        answer = BENCHMARKS[name](arguments.repeats)
        for row in answer if isinstance(answer, list) else [answer]:
            rows.append(row)
            print(
                f"| {row.what} | {row.ratio:.3g} | {row.low:.3g} to {row.high:.3g} | {row.target} "
                f"| {'yes' if row.reached else 'no'} | {row.detail} |",
                flush=True,
            )
    print("\n" + ", ".join(f"{key} {value}" for key, value in describe().items()))
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(
                {"machine": describe(), "rows": [{**row._asdict(), "reached": row.reached} for row in rows]}, file
            )


if __name__ == "__main__":
    main()
