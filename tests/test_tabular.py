"""Discrete states: gymnasium's toy-text environments are solved, by tabular SARSA(λ) and Q(λ)."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_knntd import KNNTD


def newest(name: str) -> str:
    """The id of an environment in the version of the installed gymnasium."""
    versions = [spec for spec in gym.registry.values() if spec.name == name and spec.namespace is None]
    if not versions:
        pytest.skip(f"this gymnasium has no {name}")
    return max(versions, key=lambda spec: spec.version or 0).id


def optimal_values(env: gym.Env[Any, Any], gamma: float) -> np.ndarray:
    """Value iteration on the model of a toy-text environment, shape (n_states, n_actions)."""
    model = env.unwrapped.P  # type: ignore[attr-defined]
    values = np.zeros((env.observation_space.n, env.action_space.n))  # type: ignore[attr-defined]
    for _ in range(1_000):
        best = values.max(axis=1)
        values = np.array(
            [
                [
                    sum(p * (reward + gamma * best[state] * (not end)) for p, state, reward, end in model[s][a])
                    for a in range(values.shape[1])
                ]
                for s in range(values.shape[0])
            ]
        )
    return values


def greedy_return(model: KNNTD, env_id: str, n_episodes: int, **kwargs: Any) -> float:
    env = gym.make(env_id, max_episode_steps=200, **kwargs)
    env.reset(seed=1_000)
    mean, _ = evaluate_policy(model, env, n_episodes, deterministic=True, warn=False)
    assert isinstance(mean, float)
    return mean


@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
def test_frozen_lake_without_ice(target: str) -> None:
    env_id = newest("FrozenLake")
    env = gym.make(env_id, is_slippery=False)
    # Optimistic initial values make the learner try all actions.
    model = KNNTD(env, target=target, gamma=0.95, learning_rate=0.5, trace_decay=0.9, initial_value=1.0, seed=0)
    model.learn(1_500)
    assert model.policy.q_table.shape == (16, 4)
    assert greedy_return(model, env_id, 1, is_slippery=False) == 1.0


@pytest.mark.parametrize("target", ["sarsa", "q_learning"])
def test_cliff_walking(target: str) -> None:
    env_id = newest("CliffWalking")
    # The environment is deterministic, so a step size of 1 is correct.
    model = KNNTD(
        gym.make(env_id, max_episode_steps=200), target=target, gamma=1.0, learning_rate=1.0, trace_decay=0.0,
        exploration_initial_eps=0.0, seed=0,
    )  # fmt: skip
    model.learn(10_000)
    # The shortest path, along the edge of the cliff, has 13 steps.
    assert greedy_return(model, env_id, 1) == -13.0


def test_values_are_those_of_value_iteration() -> None:
    # Every action is tried everywhere (ε = 1, off-policy, one-step): the table becomes Q*.
    env = gym.make(newest("FrozenLake"), is_slippery=False, map_name="4x4")
    model = KNNTD(
        env, target="q_learning", gamma=0.9, trace_decay=0.0, learning_rate=1.0, exploration_initial_eps=1.0,
        exploration_final_eps=1.0, seed=0,
    )  # fmt: skip
    model.learn(5_000)
    learned, optimal = model.policy.q_table.numpy(), optimal_values(env, 0.9)
    # Random actions rarely reach distant states: compare along the best path, where the values are most exact.
    assert np.abs(learned - optimal)[[0, 4, 8]].max() < 1e-12
    assert optimal[0].max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("target", ["sarsa", "q_learning"])
def test_frozen_lake(target: str) -> None:
    env_id = newest("FrozenLake")
    model = KNNTD(
        env_id, target=target, gamma=0.99, learning_rate=lambda progress: 0.02 + 0.28 * progress, trace_decay=0.5,
        initial_value=0.5, exploration_initial_eps=0.1, seed=0,
    )  # fmt: skip
    model.learn(60_000)
    # The optimal policy wins 82 of 100 episodes without the limit of 100 steps.
    assert greedy_return(model, env_id, 500) >= 0.7


@pytest.mark.slow
@pytest.mark.parametrize("target", ["sarsa", "q_learning"])
def test_taxi(target: str) -> None:
    env_id = newest("Taxi")
    model = KNNTD(
        env_id, target=target, gamma=1.0, learning_rate=1.0, trace_decay=0.3, exploration_initial_eps=0.0, seed=0
    )
    assert model.policy.q_table.shape == (500, 6)
    model.learn(300_000)
    # The mean return of the shortest paths is 7.9.
    assert greedy_return(model, env_id, 300) >= 7.0
