"""Training reaches thresholds far above random actions and safely below typical results."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import LinearSchedule
from toy_envs import DriftEnv

from sb3_knntd import KNNTD


def greedy_return(model: KNNTD, env_id: str, n_episodes: int) -> float:
    env = gym.make(env_id)
    env.reset(seed=1_000)
    mean, _ = evaluate_policy(model, env, n_episodes, deterministic=True, warn=False)
    assert isinstance(mean, float)
    return mean


@pytest.mark.parametrize(
    "settings",
    [
        {"learning_rate": LinearSchedule(0.7, 0.1, 1.0), "trace_decay": 0.95},
        {"learning_rate": LinearSchedule(0.3, 0.1, 1.0), "trace_decay": 0.8, "traces": "accumulating"},
    ],
    ids=["replacing", "accumulating"],
)
def test_mountain_car_in_ten_thousand_steps(settings: dict[str, Any]) -> None:
    model = KNNTD(
        "MountainCar-v0", points=12, n_neighbors=4, gamma=1.0, exploration_initial_eps=0.0, seed=0, **settings
    )
    model.learn(10_000)
    # Random actions have a return of -200; other seeds end between -128 and -146.
    assert greedy_return(model, "MountainCar-v0", 10) >= -170.0


def test_mountain_car_with_many_environments() -> None:
    venv = make_vec_env("MountainCar-v0", 8)
    model = KNNTD(
        venv, points=12, n_neighbors=4, gamma=1.0, learning_rate=LinearSchedule(0.7, 0.1, 1.0),
        trace_decay=0.95, exploration_initial_eps=0.0, seed=0,
    )  # fmt: skip
    model.learn(16_000)
    assert greedy_return(model, "MountainCar-v0", 10) >= -170.0


def test_values_of_episodes_of_one_step() -> None:
    # Episodes of one step with a reward of 1: every value becomes 1 everywhere.
    env = gym.wrappers.TransformReward(DriftEnv(lengths=[1], ends=["terminated"]), lambda _: 1.0)
    model = KNNTD(
        env, points=2, bounds=([-1.0, -0.05], [0.5, 0.06]), n_neighbors=4, learning_rate=0.5, seed=0,
        exploration_initial_eps=1.0, exploration_final_eps=1.0,
    )  # fmt: skip
    model.learn(600)
    starts = np.stack([DriftEnv(offset=offset).reset()[0] for offset in np.linspace(0.0, 1.0, 20)])
    np.testing.assert_allclose(model.policy.q_values(starts).numpy(), 1.0, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "threshold"), [("MountainCar-v0", -150.0), ("CartPole-v1", 300.0), ("Acrobot-v1", -150.0)]
)
def test_untuned(env_id: str, threshold: float) -> None:
    # A single seed, so the thresholds are below the medians of the benchmark.
    assert greedy_return(KNNTD(env_id, seed=0).learn(50_000), env_id, 50) >= threshold
