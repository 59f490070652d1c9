"""Shared fixtures: deterministic environments, and models small enough to be fast."""

from __future__ import annotations

import csv
import pathlib
import signal
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ON_BOX, fitting
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from toy_envs import DriftEnv, GridEnv, PushEnv

import sb3_knntd.envs  # noqa: F401  registers the continuous cart-pole
from sb3_knntd import KNNTD, ExA, KNNDyna

# All operations are tiny: more threads only slow the tests down, especially under pytest-xdist.
th.set_num_threads(1)
# A background job of a shell ignores Ctrl-C, and so would every process that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def temporary_files(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Put the log folders of SB3's loggers where pytest removes them."""
    tempfile.tempdir = str(tmp_path_factory.mktemp("temporary"))


@pytest.fixture
def algorithm() -> type[KNNTD | ExA | KNNDyna]:
    """The algorithm of ``make_model``. Modules that test both algorithms override it."""
    return KNNTD


@pytest.fixture
def env_cls(algorithm: type[KNNTD | ExA | KNNDyna]) -> type[DriftEnv]:
    """The drifting point with actions for the algorithm."""
    return PushEnv if algorithm in ON_BOX else DriftEnv


@pytest.fixture
def mountain_car(algorithm: type[KNNTD | ExA | KNNDyna]) -> str:
    """The id of gymnasium's Mountain-Car with actions for the algorithm; it has random initial states."""
    return "MountainCarContinuous-v0" if algorithm in ON_BOX else "MountainCar-v0"


@pytest.fixture
def cart_pole(algorithm: type[KNNTD | ExA | KNNDyna]) -> str:
    """The id of a cart-pole with actions for the algorithm; two of its observation dimensions are unbounded."""
    return "sb3_knntd/ContinuousCartPole-v0" if algorithm in ON_BOX else "CartPole-v1"


def _number_of_move(action: np.ndarray) -> int:
    return round(1.5 * (float(action[0]) + 1.0))


@pytest.fixture
def make_grid(algorithm: type[KNNTD | ExA | KNNDyna]) -> Callable[..., gym.Env[Any, Any]]:
    """A function ``make_grid(kind, **episodes)`` that makes the torus of cells with actions for the algorithm."""

    def make(kind: str = "discrete", **episodes: Any) -> gym.Env[Any, Any]:
        env = GridEnv(kind, **episodes)
        if algorithm in ON_BOX:
            box = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
            return gym.wrappers.TransformAction(env, _number_of_move, box)
        return env

    return make


def _monitored(env_cls: type[DriftEnv], **kwargs: Any) -> gym.Env[Any, Any]:
    return Monitor(env_cls(**kwargs))


@pytest.fixture
def make_venv(env_cls: type[DriftEnv]) -> Iterator[Callable[..., VecEnv]]:
    """A function ``make_venv(n_envs, vec_env_cls)``: drifting points with episodes of 9, 14, 6, 9, ... steps."""
    made: list[VecEnv] = []

    def make(
        n_envs: int = 1, vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv, **kwargs: Any
    ) -> VecEnv:
        # Different offsets, or all environments would be equal.
        made.append(
            vec_env_cls([partial(_monitored, env_cls, offset=0.23 * index, **kwargs) for index in range(n_envs)])
        )
        return made[-1]

    yield make
    for venv in made:
        venv.close()


@pytest.fixture
def make_model(
    algorithm: type[KNNTD | ExA | KNNDyna], make_venv: Callable[..., VecEnv]
) -> Callable[..., KNNTD | ExA | KNNDyna]:
    """
    A function ``make_model(env, **arguments)``: a model with 48 points, or points that grow, by default on a drifting
    point, seed 0. Of the arguments, KNNDyna gets those that it has.
    """

    def make(env: Any = None, **kwargs: Any) -> KNNTD | ExA | KNNDyna:
        # Given explicitly, so that tests do not depend on defaults, which may change.
        arguments: dict[str, Any] = {
            "points": (8, 6),
            "bounds": (DriftEnv.LOW, DriftEnv.HIGH),
            "n_neighbors": 4,
            "learning_rate": 0.3,
            "exploration_initial_eps": 0.1,
            "exploration_final_eps": 0.0,
            "seed": 0,
        }
        if algorithm is ExA:
            arguments |= {"action_points": 3, "exploration_hold": 2.0}
        if issubclass(algorithm, KNNDyna):
            arguments |= {"spacing": 0.1, "simulated_steps": 5}
        return algorithm(make_venv() if env is None else env, **fitting(algorithm, arguments | kwargs))

    return make


@pytest.fixture
def observations() -> np.ndarray:
    """A hundred observations inside and outside the drifting point's bounds, shape (100, 2)."""
    width = DriftEnv.HIGH - DriftEnv.LOW
    places = np.random.default_rng(3).uniform(DriftEnv.LOW - 0.2 * width, DriftEnv.HIGH + 0.2 * width, size=(100, 2))
    return places.astype(np.float32)


@pytest.fixture
def read_log() -> Callable[[pathlib.Path], list[dict[str, float]]]:
    """A function that reads the file of SB3's CSV logger: one dict per dump, without missing values."""

    def read(folder: pathlib.Path) -> list[dict[str, float]]:
        with open(folder / "progress.csv", newline="") as file:
            return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]

    return read
