"""What the behaviour tests share: environments in which everything is known, and models small enough to be quick."""

from __future__ import annotations

import csv
import pathlib
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from toy_envs import DriftEnv, GridEnv, PushEnv

import sb3_knntd.envs  # noqa: F401  registers the continuous cart-pole
from sb3_knntd import KNNTD, ExA

# Every operation here is tiny: more threads only wait for each other, the more so under pytest-xdist.
th.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def temporary_files(tmp_path_factory: pytest.TempPathFactory) -> None:
    """SB3's loggers leave a folder for each model: where pytest tidies up."""
    tempfile.tempdir = str(tmp_path_factory.mktemp("temporary"))


@pytest.fixture
def algorithm() -> type[KNNTD | ExA]:
    """Whose models ``make_model`` makes: a module whose tests hold for both overrides this to run over both."""
    return KNNTD


@pytest.fixture
def env_cls(algorithm: type[KNNTD | ExA]) -> type[DriftEnv]:
    """The drifting point with the actions that the algorithm takes."""
    return PushEnv if algorithm is ExA else DriftEnv


@pytest.fixture
def mountain_car(algorithm: type[KNNTD | ExA]) -> str:
    """The id of the mountain car with the actions that the algorithm takes: gymnasium's own, with chance in it."""
    return "MountainCarContinuous-v0" if algorithm is ExA else "MountainCar-v0"


@pytest.fixture
def cart_pole(algorithm: type[KNNTD | ExA]) -> str:
    """The id of the cart-pole with the actions that the algorithm takes: two of its dimensions have no range."""
    return "sb3_knntd/ContinuousCartPole-v0" if algorithm is ExA else "CartPole-v1"


def _number_of_move(action: np.ndarray) -> int:
    return round(1.5 * (float(action[0]) + 1.0))


@pytest.fixture
def make_grid(algorithm: type[KNNTD | ExA]) -> Callable[..., gym.Env[Any, Any]]:
    """Makes ``make_grid(kind, **episodes)``: the torus of cells with the actions that the algorithm takes."""

    def make(kind: str = "discrete", **episodes: Any) -> gym.Env[Any, Any]:
        env = GridEnv(kind, **episodes)
        if algorithm is ExA:
            box = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)
            return gym.wrappers.TransformAction(env, _number_of_move, box)
        return env

    return make


def _monitored(env_cls: type[DriftEnv], **kwargs: Any) -> gym.Env[Any, Any]:
    return Monitor(env_cls(**kwargs))


@pytest.fixture
def make_venv(env_cls: type[DriftEnv]) -> Iterator[Callable[..., VecEnv]]:
    """Makes ``make_venv(n_envs, vec_env_cls)``: drifting points whose episodes have 9, 14 and 6 steps, in turn."""
    made: list[VecEnv] = []

    def make(
        n_envs: int = 1, vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv, **kwargs: Any
    ) -> VecEnv:
        # An offset each, or all environments would live through the same.
        made.append(
            vec_env_cls([partial(_monitored, env_cls, offset=0.23 * index, **kwargs) for index in range(n_envs)])
        )
        return made[-1]

    yield make
    for venv in made:
        venv.close()


@pytest.fixture
def make_model(algorithm: type[KNNTD | ExA], make_venv: Callable[..., VecEnv]) -> Callable[..., KNNTD | ExA]:
    """Makes ``make_model(env, **arguments)``: a model with 48 points, by default of one drifting point, seed 0."""

    def make(env: Any = None, **kwargs: Any) -> KNNTD | ExA:
        # Named, that no test hangs on a default that may be found better one day.
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
        return algorithm(make_venv() if env is None else env, **{**arguments, **kwargs})

    return make


@pytest.fixture
def observations() -> np.ndarray:
    """A hundred places inside and outside of the drifting point's bounds, shape (100, 2)."""
    width = DriftEnv.HIGH - DriftEnv.LOW
    places = np.random.default_rng(3).uniform(DriftEnv.LOW - 0.2 * width, DriftEnv.HIGH + 0.2 * width, size=(100, 2))
    return places.astype(np.float32)


@pytest.fixture
def read_log() -> Callable[[pathlib.Path], list[dict[str, float]]]:
    """Reads what SB3's CSV logger wrote into a folder: one dict a dump, without what was not logged in it."""

    def read(folder: pathlib.Path) -> list[dict[str, float]]:
        with open(folder / "progress.csv", newline="") as file:
            return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]

    return read
