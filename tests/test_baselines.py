"""The baselines: true online SARSA(λ) with tile coding, and random actions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import compare_envs  # noqa: F401
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_knntd.experiments.baselines import tile_coding
from sb3_knntd.experiments.baselines.random_agent import RandomAgent
from sb3_knntd.experiments.baselines.tile_coding import TileCoder
from sb3_knntd.experiments.baselines.tile_sarsa import TileSarsa
from sb3_knntd.perception.bounds import MEASURING_STEPS, Bounds


def corner(low: list[float], high: list[float]) -> Bounds:
    return Bounds(np.array(low), np.array(high))


def test_tiles_are_those_of_the_book() -> None:
    """Figure 9.11 of the book: tilings offset by (1, 3) quarters of a tile."""
    coder = TileCoder(corner([0.0, -1.0], [2.0, 1.0]), np.array([4, 5]), n_tilings=4)
    assert coder.n_features == 4 * 5 * 6
    rng = np.random.default_rng(0)
    observations = np.concatenate([rng.uniform([0.0, -1.0], [2.0, 1.0], (200, 2)), [[0.0, -1.0], [2.0, 1.0]]])
    for observation, features in zip(observations, coder.encode(observations), strict=True):
        for tiling in range(4):
            shift = np.array([1, 3]) * tiling % 4 / 4
            column, row = np.floor((observation - [0.0, -1.0]) / 2.0 * [4, 5] + shift).astype(int)
            assert features[tiling] == (tiling * 5 + column) * 6 + row


def test_tiles_end_at_the_bounds_and_share_weights_when_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds = corner([-1.0], [1.0])
    outside, on = TileCoder(bounds, np.array([8]), 8).encode(np.array([[-9.0], [9.0], [-1.0], [1.0]])).reshape(2, 2, 8)
    np.testing.assert_array_equal(outside, on)
    whole = TileCoder(bounds, np.array([30]), 8).encode(np.linspace(-1, 1, 50)[:, None])
    assert whole.max() > 97
    monkeypatch.setattr(tile_coding, "MOST_FEATURES", 97)
    shared = TileCoder(bounds, np.array([30]), 8)
    assert shared.n_features == 97
    np.testing.assert_array_equal(shared.encode(np.linspace(-1, 1, 50)[:, None]), whole % 97)


class Recorded(TileSarsa):
    """Records features, actions and rewards."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.chosen: list[tuple[np.ndarray, int]] = []
        self.got: list[tuple[float, bool, bool, int]] = []

    def _choose(self, features: np.ndarray) -> int:
        action = super()._choose(features)
        self.chosen.append((features, action))
        return action

    def _learn_from(
        self, new_obs: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        first = len(self.chosen) - 1
        super()._learn_from(new_obs, rewards, dones, infos)
        self.got.append((float(rewards[0]), bool(dones[0]), bool(infos[0].get("TimeLimit.truncated")), first))


@pytest.mark.parametrize(
    ("gamma", "trace_decay", "initial_value"), [(1.0, 0.9, 0.0), (0.9, 0.5, -4.0), (0.95, 0.0, 0.0)]
)
def test_it_learns_as_the_book_says(gamma: float, trace_decay: float, initial_value: float) -> None:
    """Compare with the algorithm box on page 307, with dense vectors, for terminated and truncated episodes."""
    model = Recorded(
        "TilePolicy",
        "compare/Corridor-v0",
        learning_rate=0.4,
        gamma=gamma,
        trace_decay=trace_decay,
        n_tiles=6,
        n_tilings=4,
        initial_value=initial_value,
        exploration_initial_eps=0.5,
        exploration_final_eps=0.5,
        seed=1,
    ).learn(600)
    n_actions, n_features = model.policy.weights.shape

    def vector(number: int) -> np.ndarray:
        features, action = model.chosen[number]
        x = np.zeros((n_actions, n_features))
        x[action, features] = 1.0
        return x

    alpha = 0.4 / 4
    w = np.full((n_actions, n_features), initial_value / 4)
    z, q_old = np.zeros_like(w), 0.0
    for reward, done, truncated, number in model.got:
        x, x_next = vector(number), vector(number + 1)
        q = (w * x).sum()
        q_next = 0.0 if done and not truncated else (w * x_next).sum()
        delta = reward + gamma * q_next - q
        z = gamma * trace_decay * z + (1 - alpha * gamma * trace_decay * (z * x).sum()) * x
        w = w + alpha * (delta + q - q_old) * z - alpha * (q - q_old) * x
        q_old = q_next
        if done:
            z, q_old = np.zeros_like(w), 0.0
    ends = [(done, truncated) for _, done, truncated, _ in model.got]
    assert (True, True) in ends
    assert (True, False) in ends
    np.testing.assert_allclose(model.policy.weights.numpy(), w, rtol=0, atol=1e-8)
    assert evaluate_policy(model, make_vec_env("compare/Corridor-v0", 5, seed=3), 20)[0] > -11


def test_results_depend_on_the_seed_and_survive_saving(tmp_path: Path) -> None:
    first, second, other = (
        TileSarsa("TilePolicy", make_vec_env("CartPole-v1", seed=seed), seed=seed).learn(1300) for seed in (3, 3, 4)
    )
    assert th.equal(first.policy.weights, second.policy.weights)
    assert not th.equal(first.policy.weights, other.policy.weights)
    first.save(tmp_path / "model")
    loaded = TileSarsa.load(tmp_path / "model")
    observations = np.random.default_rng(0).uniform(-1, 1, (50, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observations, deterministic=True)[0], first.predict(observations, deterministic=True)[0]
    )


def test_unbounded_ranges_are_measured_first() -> None:
    model = TileSarsa("TilePolicy", "CartPole-v1", seed=0).learn(MEASURING_STEPS)
    assert not model.policy.weights.any()
    low, high = model.policy.coder.bounds.low.clone(), model.policy.coder.bounds.high.clone()
    assert (high - low > 0.5).all()
    model.learn(300, reset_num_timesteps=False)
    assert model.policy.weights.any()
    assert th.equal(low, model.policy.coder.bounds.low)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_tiles": [3, 4, 5]}, "n_tiles must be one number, or 2"),
        ({"n_tiles": 0}, "n_tiles must be an integer >= 1; got 0"),
        ({"n_tilings": 0}, "n_tilings must be an integer >= 1; got 0"),
        ({"learning_rate": 1.5}, "learning_rate"),
        ({"trace_decay": 1.01}, r"trace_decay must be a finite number in \[0, 1\]"),
        ({"exploration_fraction": 0}, r"exploration_fraction must be a finite number in \(0, 1\]"),
        ({"env": "FrozenLake-v1"}, r"takes observations in a Box of shape \(n,\)"),
    ],
)
def test_invalid_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TileSarsa(**{"policy": "TilePolicy", "env": "MountainCar-v0", **arguments})


@pytest.mark.parametrize(
    "space",
    [spaces.Discrete(3), spaces.Box(-2.0, 3.0, (2,)), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(4)],
)
def test_random_actions_are_spread_over_the_space(space: spaces.Space[Any]) -> None:
    class OneStepEnv(gym.Env[np.ndarray, Any]):
        observation_space = spaces.Box(-1.0, 1.0, (1,))
        action_space = space

        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
            return np.zeros(1, np.float32), {}

        def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            assert space.contains(action)
            return np.zeros(1, np.float32), 0.0, True, False, {}

    model = RandomAgent("RandomPolicy", make_vec_env(OneStepEnv, 2), seed=0).learn(20)
    assert model.num_timesteps == 20
    actions, _ = model.predict(np.zeros((400, 1), np.float32), deterministic=True)
    assert all(space.contains(action) for action in (actions if actions.ndim > 1 else map(np.int64, actions)))
    spread = actions.reshape(400, -1).std(axis=0)
    assert (spread > 0.4).all()
    assert math.isclose(spread[0], actions[:200].reshape(200, -1).std(axis=0)[0], rel_tol=0.2)
