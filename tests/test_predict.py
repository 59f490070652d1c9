"""``predict`` and the inspection methods of the policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv
from toy_envs import DriftEnv

from sb3_knntd import KNNTD, ExA, KNNDyna, Perception

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeGrid = Callable[..., gym.Env[Any, Any]]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]

# Only for algorithms with Discrete actions.
KNNTD_ONLY = pytest.mark.parametrize("algorithm", [KNNTD])


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


@pytest.fixture
def model(make_model: MakeModel) -> KNNTD | ExA | KNNDyna:
    return make_model().learn(200)


@pytest.mark.parametrize("deterministic", [True, False])
def test_single_observation_gives_single_action(model: KNNTD | ExA | KNNDyna, deterministic: bool) -> None:
    observation, _ = DriftEnv().reset()
    action, state = model.predict(observation, deterministic=deterministic)
    assert np.shape(action) == model.action_space.shape
    assert model.action_space.contains(action)
    assert state is None


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("batch", [1, 7, 100])
def test_batch_gives_one_action_a_row(
    model: KNNTD | ExA | KNNDyna, observations: np.ndarray, batch: int, deterministic: bool
) -> None:
    actions, _ = model.predict(observations[:batch], deterministic=deterministic)
    assert actions.shape == (batch, *(model.action_space.shape or ()))
    assert all(model.action_space.contains(action) for action in actions)


def test_batch_agrees_with_single(model: KNNTD | ExA | KNNDyna, observations: np.ndarray) -> None:
    together, _ = model.predict(observations, deterministic=True)
    alone = [model.predict(observation, deterministic=True)[0] for observation in observations]
    np.testing.assert_array_equal(together, alone)
    assert len(np.unique(alone)) > 1, "a constant policy would make this test empty"


@KNNTD_ONLY
def test_deterministic_action_is_the_best_by_q_values(model: KNNTD | ExA | KNNDyna, observations: np.ndarray) -> None:
    actions, _ = model.predict(observations, deterministic=True)
    assert actions.tolist() == model.policy.q_values(observations).argmax(dim=1).tolist()


@KNNTD_ONLY
def test_deterministic_prediction_breaks_ties_to_the_lowest_index(
    make_model: MakeModel, observations: np.ndarray
) -> None:
    # Without learning all actions have equal values, and training would break ties at random.
    actions, _ = make_model(tie_break="random").predict(observations, deterministic=True)
    assert not actions.any()


def test_prediction_does_not_change_the_model(
    model: KNNTD | ExA | KNNDyna, make_model: MakeModel, observations: np.ndarray
) -> None:
    model.predict(observations)
    model.predict(observations[0], deterministic=True)
    model.policy.q_values(observations)
    model.learn(100, reset_num_timesteps=False)
    unasked = make_model().learn(200).learn(100, reset_num_timesteps=False)
    assert th.equal(model.policy.q_table, unasked.policy.q_table)


def test_q_values_are_the_weighted_rows_of_the_table(model: KNNTD | ExA | KNNDyna, observations: np.ndarray) -> None:
    perception = model.policy.perceive(observations)
    assert isinstance(perception, Perception)
    assert perception.indices.shape == perception.probabilities.shape == (len(observations), model.n_neighbors)
    th.testing.assert_close(perception.probabilities.sum(dim=1), th.ones(len(observations), dtype=th.float64))
    rows = model.policy.q_table[perception.indices]
    values = (perception.probabilities[..., None] * rows).sum(dim=1)
    th.testing.assert_close(model.policy.q_values(observations), values)


def test_perceived_points_are_the_nearest(model: KNNTD | ExA | KNNDyna, observations: np.ndarray) -> None:
    points = model.policy.points.numpy()
    width = DriftEnv.HIGH - DriftEnv.LOW
    distances = (((observations[:, None, :] - points) / width) ** 2).sum(axis=2)
    chosen = np.take_along_axis(distances, model.policy.perceive(observations).indices.numpy(), axis=1)
    np.testing.assert_allclose(chosen, np.sort(distances, axis=1)[:, : model.n_neighbors], rtol=1e-9)


def test_single_observation_is_perceived_as_one_row(model: KNNTD | ExA | KNNDyna, observations: np.ndarray) -> None:
    assert model.policy.perceive(observations[0]).indices.shape == (1, model.n_neighbors)
    assert model.policy.q_values(observations[0]).shape == (1, 3)


def test_tensors_are_perceived_like_arrays(model: KNNTD | ExA | KNNDyna, observations: np.ndarray) -> None:
    assert th.equal(model.policy.q_values(th.from_numpy(observations)), model.policy.q_values(observations))


@pytest.mark.parametrize("kind", ["discrete", "multi_discrete"])
def test_states_by_number(algorithm: Algorithm, make_grid: MakeGrid, kind: str) -> None:
    env = make_grid(kind)
    model = algorithm(env, seed=0).learn(50)
    observation, _ = env.reset()
    action, _ = model.predict(observation, deterministic=True)
    assert model.action_space.contains(action)
    actions, _ = model.predict(np.stack([np.asarray(observation)] * 3), deterministic=True)
    assert actions.tolist() == [action.tolist()] * 3


def test_plain_int_is_a_state(algorithm: Algorithm, make_grid: MakeGrid) -> None:
    model = algorithm(make_grid(), seed=0)
    assert model.policy.perceive(5).indices.tolist() == [[5]]
    assert model.action_space.contains(model.predict(5)[0])


class ShiftedActions(gym.ActionWrapper[Any, Any, Any]):
    """The same environment with actions numbered from ``first``; other numbers are an error."""

    def __init__(self, env: gym.Env[Any, Any], first: int) -> None:
        super().__init__(env)
        self.first = first
        self.action_space = spaces.Discrete(int(env.action_space.n), start=first)  # type: ignore[attr-defined]

    def action(self, action: Any) -> Any:
        assert self.action_space.contains(action), f"{action} is no action"
        return action - self.first


@KNNTD_ONLY
@pytest.mark.parametrize("first", [-1, 5])
def test_actions_may_start_anywhere(make_model: MakeModel, observations: np.ndarray, first: int) -> None:
    shifted = make_model(ShiftedActions(DriftEnv(), first), exploration_initial_eps=0.5).learn(200)
    plain = make_model(DriftEnv(), exploration_initial_eps=0.5).learn(200)
    assert th.equal(shifted.policy.q_table, plain.policy.q_table)
    actions, _ = shifted.predict(observations, deterministic=True)
    assert (actions - first).tolist() == plain.predict(observations, deterministic=True)[0].tolist()


@pytest.mark.parametrize("wrong", [np.zeros(3, np.float32), np.zeros((4, 3), np.float32), np.float32(0.0)])
def test_observation_of_another_shape_is_refused(model: KNNTD | ExA | KNNDyna, wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match="shape"):
        model.predict(wrong)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_observation_that_is_not_finite_is_refused(model: KNNTD | ExA | KNNDyna, wrong: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        model.predict(np.array([0.0, wrong], dtype=np.float32))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_evaluate_policy(model: KNNTD | ExA | KNNDyna, make_venv: Callable[..., VecEnv], n_envs: int) -> None:
    returns, lengths = evaluate_policy(
        model, make_venv(n_envs), n_eval_episodes=9, return_episode_rewards=True, deterministic=True
    )
    assert len(returns) == 9
    assert set(lengths) == {9, 14, 6}
    mean, _ = evaluate_policy(model, make_venv(n_envs), n_eval_episodes=9)
    assert mean == pytest.approx(np.mean(returns))


def test_tables_may_be_float32(make_model: MakeModel, observations: np.ndarray) -> None:
    half = make_model(policy_kwargs={"dtype": th.float32}).learn(100)
    full = make_model().learn(100)
    assert full.policy.q_table.dtype == th.float64
    assert half.policy.q_table.dtype == half.policy.q_values(observations).dtype == th.float32
    assert half.predict(observations)[0].shape == full.predict(observations)[0].shape
