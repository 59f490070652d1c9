"""Rows of `python -m benchmarks.speed` about environments that are stepped together, and about first use."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_knntd.envs  # noqa: F401
from benchmarks.rows import Row, compare, steps_per_second
from sb3_knntd import KNNTD, ExA
from sb3_knntd.vec_envs import CompiledVecEnv, EnvPoolVecEnv, GymnasiumVecEnv, LeanVecEnv

#: Number of environments that are stepped together.
N_ENVS = 64
#: Steps of all environments in one measurement.
N_STEPS = 400 * N_ENVS
PAPER = ("MountainCar", "CartPole", "ContinuousCartPole", "Acrobot")


def continued(model: Any) -> Callable[[], float]:
    """Steps per second of `learn`, which goes on where it was; the first call is a warm-up."""
    model.learn(4 * N_STEPS)
    return lambda: steps_per_second(lambda n: model.learn(n, reset_num_timesteps=False), N_STEPS)


def discrete_loop(step: Callable[[np.ndarray], Any], n_actions: int, dtype: type = np.int64) -> Callable[[], float]:
    """Steps per second of a loop with random actions, drawn beforehand."""
    actions = np.random.default_rng(0).integers(0, n_actions, (400, N_ENVS)).astype(dtype)

    def loop(n_steps: int) -> None:
        for i in range(n_steps // N_ENVS):
            step(actions[i])

    return lambda: steps_per_second(loop, N_STEPS)


def envpool_model(env_id: str) -> KNNTD:
    return KNNTD(EnvPoolVecEnv(env_id, N_ENVS), seed=0)


def against_envpool(repeats: int, env_id: str) -> list[Row]:
    import envpool

    pool = envpool.make_gymnasium(env_id, num_envs=N_ENVS)
    pool.reset()
    learn, own = continued(envpool_model(env_id)), discrete_loop(pool.step, int(pool.action_space.n), np.int32)
    what = f"{env_id}, {N_ENVS} environments of EnvPool"
    row = compare(f"KNNTD.learn over EnvPool's own loop, {what}", ">= 0.6", learn, own, 4 * repeats, "steps/s")
    rates = [learn() / 300_000 for _ in range(repeats)]
    return [row, Row.of(f"KNNTD.learn, {what}, in 300,000 steps/s", rates, ">= 1", "")]


def against_ppo(repeats: int) -> Row:
    learn = continued(envpool_model("CartPole-v1"))
    ppo = PPO("MlpPolicy", EnvPoolVecEnv("CartPole-v1", N_ENVS), n_steps=128, batch_size=1024, device="cpu")
    return compare(
        f"KNNTD.learn over PPO's, CartPole-v1, {N_ENVS} environments of EnvPool",
        ">= 10",
        learn,
        lambda: steps_per_second(lambda n: ppo.learn(n, reset_num_timesteps=False), 128 * N_ENVS),
        repeats,
        "steps/s",
    )


def numpy_against_python(repeats: int) -> Row:
    together = GymnasiumVecEnv(gym.make_vec("CartPole-v1", N_ENVS))
    alone = make_vec_env("CartPole-v1", N_ENVS, seed=0)
    return compare(
        f"KNNTD.learn with gymnasium's NumPy environments over DummyVecEnv, CartPole-v1, n_envs {N_ENVS}",
        ">= 1",
        continued(KNNTD(together, seed=0)),
        continued(KNNTD(alone, seed=0)),
        repeats,
        "steps/s",
    )


def paper_venv(name: str, n_envs: int, vec_env_cls: type[DummyVecEnv] = CompiledVecEnv) -> VecEnv:
    return make_vec_env(f"sb3_knntd/{name}-v0", n_envs, seed=0, vec_env_cls=vec_env_cls)


def paper_model(name: str, n_envs: int, vec_env_cls: type[DummyVecEnv] = CompiledVecEnv) -> KNNTD | ExA:
    algorithm = ExA if name == "ContinuousCartPole" else KNNTD
    return algorithm(paper_venv(name, n_envs, vec_env_cls), seed=0)


def compiled_environments(repeats: int) -> list[Row]:
    rows = []
    for name in PAPER:
        venv = paper_venv(name, N_ENVS)
        venv.reset()
        actions = np.array([[venv.action_space.sample() for _ in range(N_ENVS)] for _ in range(400)])

        def loop(n_steps: int, venv: VecEnv = venv, actions: np.ndarray = actions) -> None:
            for i in range(n_steps // N_ENVS):
                venv.step(actions[i])

        loop(N_STEPS)
        rates = [steps_per_second(loop, N_STEPS) / 500_000 for _ in range(repeats)]
        what = f"CompiledVecEnv, {name}-v0, n_envs {N_ENVS}, in 500,000 steps/s"
        rows.append(Row.of(what, rates, ">= 1", f"{500_000 * statistics.median(rates):,.4g} steps/s"))
    return rows


def compiled_against_python(repeats: int) -> list[Row]:
    return [
        compare(
            f"learn with CompiledVecEnv over DummyVecEnv, {name}-v0, n_envs 1",
            ">= 1",
            continued(paper_model(name, 1)),
            continued(paper_model(name, 1, DummyVecEnv)),
            repeats,
            "steps/s",
        )
        for name in PAPER
    ]


def lean_against_dummy(repeats: int) -> Row:
    def model(vec_env_cls: type[DummyVecEnv]) -> KNNTD:
        return KNNTD(make_vec_env("MountainCar-v0", 1, seed=0, vec_env_cls=vec_env_cls), seed=0)

    return compare(
        "learn with LeanVecEnv over DummyVecEnv, MountainCar-v0, n_envs 1",
        ">= 1",
        continued(model(LeanVecEnv)),
        continued(model(DummyVecEnv)),
        4 * repeats,
        "steps/s",
    )


def side_by_side(repeats: int) -> list[Row]:
    """
    The most that many seeds in one process could gain: 64 environments in one compiled call, with one table in place of
    64, over one environment. Both use the compiled environments: with Python ones the environments dominate.
    """
    return [
        compare(
            f"learn with 64 environments over 1, {name}-v0, compiled",
            ">= 3",
            continued(paper_model(name, N_ENVS)),
            continued(paper_model(name, 1)),
            repeats,
            "steps/s",
        )
        for name in PAPER
    ]


FIRST_USE = """
import time
start = time.perf_counter()
from sb3_knntd import {algorithm}
{algorithm}({env_id!r}).learn(1)
print(time.perf_counter() - start)
"""


def first_use(repeats: int) -> list[Row]:
    rows = []
    for algorithm, env_id in (("KNNTD", "MountainCar-v0"), ("ExA", "MountainCarContinuous-v0")):
        seconds = []
        for _ in range(min(repeats, 3)):
            with tempfile.TemporaryDirectory() as cache:
                environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
                command = [sys.executable, "-c", FIRST_USE.format(algorithm=algorithm, env_id=env_id)]
                done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
                seconds.append(float(done.stdout))
        what = f"{algorithm}: import, compilation and first step with an empty cache, seconds"
        rows.append(Row.of(what, seconds, "<= 10", ""))
    return rows


def quietly(benchmark: Callable[[int], Any]) -> Callable[[int], Any]:
    """The benchmark without gymnasium's warnings about EnvPool's spaces."""

    def run(repeats: int) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            return benchmark(repeats)

    return run


BENCHMARKS: dict[str, Callable[[int], Any]] = {
    "envpool_cart_pole": quietly(lambda repeats: against_envpool(repeats, "CartPole-v1")),
    "envpool_mountain_car": quietly(lambda repeats: against_envpool(repeats, "MountainCar-v0")),
    "envpool_ppo": quietly(against_ppo),
    "gymnasium_vector": numpy_against_python,
    "lean": lean_against_dummy,
    "compiled": compiled_environments,
    "compiled1": compiled_against_python,
    "side_by_side": side_by_side,
    "first_use": first_use,
}
