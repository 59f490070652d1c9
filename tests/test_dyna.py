"""KNNDyna as an SB3 algorithm: learning, exploring, saving and resuming."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import DriftEnv

from sb3_knntd import KNNDyna
from sb3_knntd.planning import LocalPlanner

ENVS = ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"]


def state_of(model):
    """All numbers of a model by name."""
    flat = {}

    def add(prefix, value):
        if isinstance(value, dict):
            for name, part in value.items():
                add(f"{prefix}.{name}", part)
        else:
            flat[prefix] = value

    for name, state in model.get_parameters().items():
        add(name, state)
    return flat


def assert_equal_models(one, other):
    a, b = state_of(one), state_of(other)
    assert a.keys() == b.keys()
    for name, value in a.items():
        if isinstance(value, th.Tensor):
            assert th.equal(value, b[name]), name
        elif not name.endswith("planning_seconds"):
            assert value == b[name], name


@pytest.mark.parametrize("env_id", ENVS)
def test_same_seed_same_result(env_id):
    models = [KNNDyna(make_vec_env(env_id, 2, seed=3), seed=3).learn(300) for _ in range(2)]
    assert_equal_models(*models)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("env_id", ENVS)
def test_a_resumed_run_equals_an_uninterrupted_one(env_id, n_envs, tmp_path):
    venv = make_vec_env(env_id, n_envs, seed=1)
    model = KNNDyna(venv, seed=1).learn(240)
    model.save(tmp_path / "model")
    snapshot = copy.deepcopy(venv)
    model.learn(240, reset_num_timesteps=False)
    resumed = KNNDyna.load(tmp_path / "model", env=snapshot, force_reset=False)
    resumed.learn(240, reset_num_timesteps=False)
    assert_equal_models(model, resumed)


@pytest.mark.parametrize("env_id", ENVS)
def test_a_loaded_model_acts_and_predicts_the_same(env_id, tmp_path):
    model = KNNDyna(env_id, seed=0).learn(300)
    model.save(tmp_path / "model")
    loaded = KNNDyna.load(tmp_path / "model")
    observations = [model.observation_space.sample() for _ in range(20)]
    for observation in observations:
        if isinstance(model.observation_space, spaces.Box):
            observation = np.clip(observation, -3.0, 3.0)
        action, _ = model.predict(observation, deterministic=True)
        np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], action)
        np.testing.assert_equal(loaded.predict_next(observation, action), model.predict_next(observation, action))


def test_a_few_thousand_steps_are_enough():
    model = KNNDyna("Pendulum-v1", seed=0).learn(1_500)
    mean, _ = evaluate_policy(model, make_vec_env("Pendulum-v1", seed=100), n_eval_episodes=20)
    # Random actions get about -1200, a good controller -150.
    assert mean > -350


class Line(gym.Env):
    """The agent moves along a line by its action; the goal at 1 ends the episode."""

    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, action_space):
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = float(self.np_random.uniform(-1.0, 0.0))
        return np.array([self.place], np.float32), {}

    def step(self, action):
        move = (int(action) - 7 - 1) if isinstance(self.action_space, spaces.Discrete) else float(action[0])
        self.place = float(np.clip(self.place + 0.1 * move, -1.0, 1.0))
        done = self.place >= 0.95
        return np.array([self.place], np.float32), -1.0, done, False, {}


@pytest.mark.parametrize("action_space", [spaces.Discrete(3, start=7), spaces.Box(-1.0, 1.0, (1,), np.float32)])
def test_predict_next_tells_what_the_environment_does(action_space):
    env = gym.wrappers.TimeLimit(Line(action_space), 50)
    model = KNNDyna(env, seed=0).learn(800)
    right = 9 if isinstance(action_space, spaces.Discrete) else np.array([1.0], np.float32)
    prediction = model.predict_next(np.array([0.0], np.float32), right)
    assert prediction.observation == pytest.approx([0.1], abs=0.01)
    assert prediction.reward == pytest.approx(-1.0)
    assert prediction.known
    assert prediction.end < 0.1
    assert model.predict_next(np.array([0.93], np.float32), right).end > 0.5
    assert not model.predict_next(np.array([30.0], np.float32), right).known


def test_predict_next_refuses_what_does_not_fit():
    model = KNNDyna("CartPole-v1", seed=0)
    with pytest.raises(ValueError, match=r"learned nothing yet"):
        model.predict_next(np.zeros(4), 0)
    model.learn(100)
    with pytest.raises(ValueError, match=r"observation must have shape \(4,\); got \(3,\)"):
        model.predict_next(np.zeros(3), 0)
    with pytest.raises(ValueError, match=r"observation must be finite"):
        model.predict_next(np.full(4, np.nan), 0)
    with pytest.raises(ValueError, match=r"actions must be from 0 to 1"):
        model.predict_next(np.zeros(4), 5)


def test_the_log_tells_of_the_model():
    model = KNNDyna("CartPole-v1", seed=0).learn(600)
    figures = model._log()
    assert figures["train/n_transitions"] == 600
    assert figures["train/n_points"] == model.policy.perceiver.points.n_points
    assert 0.0 <= figures["train/unknown_share"] < 1.0
    assert 0.0 < figures["train/planning_time"] < 1.0
    assert figures["train/model_error"] < 0.1
    assert "train/exploration_rate" not in figures


def test_the_buffer_is_bounded():
    model = KNNDyna("Pendulum-v1", buffer_size=300, seed=0).learn(1_000)
    assert 260 <= model.learner.planner.n_transitions <= 300
    assert np.isfinite(model.policy.q_table.numpy()).all()


def test_points_are_bounded():
    model = KNNDyna("Pendulum-v1", max_points=60, seed=0).learn(600)
    points = model.policy.perceiver.points
    assert points.n_points <= 60
    assert float(points.spacing) > points.initial_spacing
    assert model.policy.bandwidth == pytest.approx(0.7 * float(points.spacing))


def test_two_dimensions_of_action():
    class Point(gym.Env):
        observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        action_space = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 4.0], np.float32))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.place = self.np_random.uniform(-1.0, 1.0, 2)
            return self.place.astype(np.float32), {}

        def step(self, action):
            self.place = np.clip(self.place + 0.2 * (np.asarray(action) * [1.0, 0.5] - [0.0, 1.0]), -1.0, 1.0)
            return self.place.astype(np.float32), -float(np.abs(self.place).sum()), False, False, {}

    env = gym.wrappers.TimeLimit(Point(), 30)
    model = KNNDyna(env, seed=0).learn(1_000)
    assert model.policy.q_table.shape[1] == 9
    mean, _ = evaluate_policy(model, DummyVecEnv([lambda: gym.wrappers.TimeLimit(Point(), 30)]), n_eval_episodes=20)
    assert mean > -12.0


def test_learn_from_transitions():
    from sb3_knntd.learners.base import Transitions

    env = gym.make("Pendulum-v1")
    env.action_space.seed(0)
    rows, obs = [], env.reset(seed=0)[0]
    for _ in range(2_000):
        action = env.action_space.sample()
        after, reward, terminated, truncated, _ = env.step(action)
        rows.append((obs, action, reward, after, terminated, terminated or truncated))
        obs = env.reset()[0] if terminated or truncated else after
    model = KNNDyna(env, seed=0)
    model.learner.update(Transitions(*(np.array(each) for each in zip(*rows, strict=True))), 0.2, 0.9)
    random, learned = (
        evaluate_policy(each, make_vec_env("Pendulum-v1", seed=100), n_eval_episodes=5)[0]
        for each in (KNNDyna(env, seed=0), model)
    )
    assert learned > random + 500


def test_the_model_is_learned_from_the_steps_of_a_controller(capsys):
    def controller(observation):
        return int(observation[2] + observation[3] > 0.0)

    model = KNNDyna("CartPole-v1", seed=0, simulated_steps=20, verbose=1)
    assert model.imitate(controller, n_steps=400) is model
    assert "The controller's mean return over 400 steps" in capsys.readouterr().out
    assert model.learner.planner.n_transitions == 400
    env = gym.make("CartPole-v1")
    observation, _ = env.reset(seed=5)
    for _ in range(20):
        action = controller(observation)
        prediction = model.predict_next(observation, action)
        observation, reward, *_ = env.step(action)
        assert prediction.observation == pytest.approx(observation, abs=0.02)
        assert prediction.reward == pytest.approx(reward)
    model.learn(100)
    assert model.learner.planner.n_transitions == 500
    with pytest.raises(ValueError, match="controller must be a function"):
        model.imitate(3)


def distance_cost(observation, action, next_observation):
    return -abs(next_observation[0] - 0.5) - 0.01 * abs(action[0])


def test_a_known_reward_function_replaces_the_rewards():
    class Silent(Line):
        """It tells no reward."""

        def step(self, action):
            observation, _, _, truncated, info = super().step(action)
            return observation, 0.0, False, truncated, info

    env = gym.wrappers.TimeLimit(Silent(spaces.Box(-1.0, 1.0, (1,), np.float32)), 50)
    model = KNNDyna(env, reward_function=distance_cost, seed=0).learn(800)
    observation, _ = env.reset(seed=5)
    for _ in range(40):
        observation, *_ = env.step(model.predict(observation, deterministic=True)[0])
    assert observation == pytest.approx([0.5], abs=0.05)
    action = np.array([0.3], np.float32)
    prediction = model.predict_next(observation, action)
    assert prediction.reward == pytest.approx(distance_cost(observation, action, prediction.observation))


def test_reward_functions_are_checked():
    with pytest.raises(ValueError, match=r"reward_function must be a function"):
        KNNDyna("Pendulum-v1", reward_function=3.0)
    with pytest.raises(ValueError, match=r"reward_function cannot be compiled by numba"):
        KNNDyna("Pendulum-v1", reward_function=lambda observation, action, after: gym.make("x"))
    with pytest.raises(ValueError, match=r"reward_function must return a finite number"):
        KNNDyna("Pendulum-v1", reward_function=lambda observation, action, after: np.nan)
    with pytest.raises(ValueError, match=r"reward_function needs a Box of observations"):
        KNNDyna("FrozenLake-v1", reward_function=lambda observation, action, after: 0.0)


def test_an_episode_that_begins_outside_of_what_was_seen() -> None:
    """The planner's model and values follow when the points are laid anew."""

    class FarAway(DriftEnv):
        def _observe(self) -> Any:
            return np.float32([2.5, 0.0])

    model = KNNDyna(DriftEnv(), spacing=0.1, simulated_steps=5, seed=0).learn(150)
    before = len(model.policy.points)
    model.set_env(FarAway())
    for n_steps in (3, 60):
        model.learn(n_steps, reset_num_timesteps=False)
        planner = model.learner.planner
        assert isinstance(planner, LocalPlanner)
        assert len(planner.known) == len(model.policy.points) == len(model.policy.q_table) != before
        scaled = model.policy.perceiver.points.coordinates(model.policy.perceiver.bounds).numpy()
        np.testing.assert_array_equal(planner.model.arrays.points[: len(scaled)], scaled)
    assert model.predict_next(np.float32([2.5, 0.0]), 1).known
