"""
Short runs whose tables are stored in ``tests/data/recorded_tables.npz``. Refactoring must not change a bit of them.

Models and a filter that were saved at the same time must still load.

``python tests/recorded_runs.py`` records them again. Do this only if results are meant to change, and say so in the
CHANGELOG.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from toy_envs import EpisodeEnv

from sb3_knntd import KNNTD, ExA, VecDeltaFilter
from sb3_knntd.experiments.baselines.tile_sarsa import TileSarsa

DATA = Path(__file__).parent / "data"
RECORDED = DATA / "recorded_tables.npz"
#: Results of :func:`continued` for the files of ``SAVED``, and of :func:`filtered` for the filter's file.
CONTINUED = DATA / "continued_tables.npz"


class RationalEnv(EpisodeEnv):
    """A point on a line, pushed by its action. Its dynamics are sums and products only, equal on every machine.

    :param n_actions: number of Discrete actions; 0 for a Box
    :param action_dim: number of dimensions of the Box
    :param bounded: whether the observation space is bounded
    :param offset: shifts the initial states
    """

    def __init__(
        self, n_actions: int = 3, action_dim: int = 1, bounded: bool = True, offset: float = 0.0, **episodes: Any
    ) -> None:
        super().__init__(**episodes)
        self.offset = offset
        high = np.float32([2.0, 0.5]) if bounded else np.float32([np.inf, np.inf])
        self.observation_space = spaces.Box(-high, high, dtype=np.float32)
        self.action_space = spaces.Discrete(n_actions) if n_actions else spaces.Box(-1.0, 1.0, (action_dim,))
        self.x = self.v = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._begin_episode()
        self.x = -0.9 + 1.8 * ((0.6180339887 * (self.episode + 1) + self.offset) % 1.0)
        self.v = 0.0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if isinstance(self.action_space, spaces.Discrete):
            push = float(action) - 1.0
        else:
            push = float(sum(np.asarray(action, dtype=np.float64).tolist()))
        self.v = 0.9 * self.v + 0.05 * push - 0.02 * self.x
        self.x = min(max(self.x + self.v, -2.5), 2.5)
        reward = 1.0 - self.x * self.x - 0.1 * push * push
        terminated, truncated = self._end_of_step()
        return self._observe(), reward, terminated, truncated, {}

    def _observe(self) -> Any:
        return np.array([self.x, self.v], dtype=np.float32)


def make_venv(n_envs: int = 1, **arguments: Any) -> VecEnv:
    return DummyVecEnv([partial(RationalEnv, offset=0.23 * index, **arguments) for index in range(n_envs)])


_SCATTERED = (np.arange(120).reshape(60, 2) * [0.61803, 0.41421]) % 1.0 * [4.0, 1.0] - [2.0, 0.5]

#: For each run: algorithm, arguments of its environments, its own arguments.
RUNS: dict[str, tuple[type[KNNTD | ExA], dict[str, Any], dict[str, Any]]] = {
    "knntd": (KNNTD, {}, {}),
    "knntd_paper": (KNNTD, {}, {"step_size": "paper", "traces": "accumulating", "learning_rate": 0.2}),
    "knntd_q_learning": (KNNTD, {}, {"target": "q_learning", "reset_other_actions": True}),
    "knntd_expected_sarsa": (KNNTD, {}, {"target": "expected_sarsa", "tie_break": "first"}),
    "knntd_4_envs": (KNNTD, {"n_envs": 4}, {}),
    "knntd_hashed": (KNNTD, {}, {"points": 400, "policy_kwargs": {"table": "hashed"}}),
    "knntd_float32": (KNNTD, {}, {"policy_kwargs": {"dtype": th.float32}}),
    "knntd_scattered": (KNNTD, {}, {"points": _SCATTERED, "search": "brute"}),
    "knntd_kd_tree": (KNNTD, {}, {"points": _SCATTERED, "search": "kd_tree"}),
    "knntd_one_step": (KNNTD, {}, {"trace_decay": 0.0, "n_neighbors": 1}),
    "knntd_adaptive": (KNNTD, {}, {"bounds": "adaptive"}),
    "knntd_open": (KNNTD, {"bounded": False}, {"verbose": 0}),
    "knntd_softmax": (KNNTD, {}, {"exploration": "softmax", "temperature": 0.5}),
    "knntd_gaussian": (KNNTD, {}, {"weights": "gaussian", "bandwidth": 0.3}),
    "knntd_torch": (KNNTD, {"n_envs": 2}, {"policy_kwargs": {"compiled": False}}),
    "exa": (ExA, {"n_actions": 0}, {}),
    "exa_per_neighbor": (ExA, {"n_actions": 0, "n_envs": 3}, {"exploration": "per_neighbor"}),
    "exa_factored": (ExA, {"n_actions": 0, "action_dim": 2}, {"action_table": "factored", "exploration_hold": 3.0}),
    "exa_torch": (ExA, {"n_actions": 0}, {"policy_kwargs": {"compiled": False}}),
}

#: Runs that compute exponentials, whose last bit depends on the machine's math library.
INEXACT = {"knntd_softmax", "knntd_gaussian"}


#: The runs with a saved model in the first version of the file format.
SAVED = ("knntd_4_envs", "knntd_hashed", "exa")
LENGTHS: dict[str, Any] = {"lengths": (9, 57, 31), "ends": ("terminated", "truncated")}
FILTER = DATA / "saved_filter.zip"


def saved_file(name: str) -> Path:
    """
    :param name: name of a run in ``SAVED``
    :return: the file of its model, saved after 500 steps
    """
    return DATA / f"saved_{name}.zip"


def make_model(name: str) -> KNNTD | ExA:
    """
    :param name: name of a run in ``RUNS``
    :return: its untrained model
    """
    algorithm, environment, arguments = RUNS[name]
    return algorithm(make_venv(**LENGTHS, **environment), **{"points": 9, "seed": 3, **arguments})


def table_of(name: str) -> np.ndarray:
    """
    :param name: name of a run in ``RUNS``
    :return: the table after the run, shape (n_rows, n_actions)
    """
    table: np.ndarray = make_model(name).learn(1600).policy.q_table.numpy()
    return table


def tile_weights() -> np.ndarray:
    """
    :return: the final weights of SARSA(λ) with tile coding, shape (n_actions, n_features)
    """
    model = TileSarsa("TilePolicy", make_venv(**LENGTHS), n_tiles=5, n_tilings=4, seed=3)
    weights: np.ndarray = model.learn(1600).policy.weights.numpy()
    return weights


def continued(name: str) -> np.ndarray:
    """
    :param name: name of a run in ``SAVED``
    :return: the table of its saved model after 300 further steps, shape (n_rows, n_actions)
    """
    algorithm, environment, _ = RUNS[name]
    model = algorithm.load(saved_file(name), env=make_venv(**LENGTHS, **environment))
    table: np.ndarray = model.learn(300, reset_num_timesteps=False).policy.q_table.numpy()
    return table


def filtered(venv: VecDeltaFilter) -> np.ndarray:
    """
    :param venv: a filter over one :class:`RationalEnv`
    :return: its estimates in 100 steps, shape (100, 2)
    """
    venv.reset()
    return np.array([venv.step(np.array([step % 3]))[0][0] for step in range(100)])


if __name__ == "__main__":
    DATA.mkdir(exist_ok=True)
    np.savez_compressed(RECORDED, tile_sarsa=tile_weights(), **{name: table_of(name) for name in RUNS})
    for name in SAVED:
        make_model(name).learn(500).save(saved_file(name))
    venv = VecDeltaFilter(make_venv(**LENGTHS))
    filtered(venv)
    venv.save(FILTER)
    loaded = VecDeltaFilter.load(FILTER, make_venv(**LENGTHS))
    np.savez_compressed(CONTINUED, filter=filtered(loaded), **{name: continued(name) for name in SAVED})
