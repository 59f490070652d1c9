"""Using a model: construction, continued training, other environments, and parameters."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS, TD_ONLY, fitting
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from toy_envs import DriftEnv, GridEnv

from sb3_knntd import KNNTD, ExA, KNNDyna

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeGrid = Callable[..., gym.Env[Any, Any]]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


# ------------------------------------------------------------------- making


def test_every_way_of_calling_is_the_same(algorithm: Algorithm, mountain_car: str) -> None:
    env_id = mountain_car
    policy_class = algorithm.policy_aliases["KNNPolicy"]

    def env() -> gym.Env[Any, Any]:
        return gym.make(env_id)

    calls: list[Callable[..., KNNTD | ExA | KNNDyna]] = [
        lambda **kw: algorithm(env_id, **kw),
        lambda **kw: algorithm("KNNPolicy", env(), **kw),
        lambda **kw: algorithm("KNNPolicy", env_id, **kw),
        lambda **kw: algorithm(policy_class, env(), **kw),
        lambda **kw: algorithm(policy="KNNPolicy", env=env(), **kw),
        lambda **kw: algorithm(env=env(), **kw),
        lambda **kw: algorithm(env=env_id, **kw),
        lambda **kw: algorithm(env(), **kw),
        lambda **kw: algorithm(DummyVecEnv([env]), **kw),
    ]
    arguments = fitting(algorithm, {"seed": 0, "points": 8, "n_neighbors": 4})
    models = [call(**arguments).learn(100) for call in calls]
    assert isinstance(models[0], BaseAlgorithm)
    assert isinstance(models[0].policy, policy_class)
    assert models[0].policy.q_table.any()
    for model in models[1:]:
        assert type(model.policy) is type(models[0].policy)
        assert th.equal(model.policy.q_table, models[0].policy.q_table)


def test_calls_of_the_documentation() -> None:
    env = gym.make("MountainCar-v0")
    assert KNNTD("MountainCar-v0", seed=0).policy.points.shape[1] == 2
    assert KNNTD("KNNPolicy", env).policy.q_table.shape[1] == 3
    assert KNNTD(env=env, n_neighbors=4, points=(20, 15)).policy.points.shape == (300, 2)


def test_points_are_in_observation_units() -> None:
    points = KNNTD("MountainCar-v0", points=(20, 15)).policy.points.numpy()
    np.testing.assert_allclose(points.min(axis=0), [-1.2, -0.07], rtol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), [0.6, 0.07], rtol=1e-6)
    assert len(np.unique(points[:, 0].round(6))) == 20
    assert len(np.unique(points[:, 1].round(6))) == 15


def test_scattered_points_are_where_they_were_put() -> None:
    places = np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], size=(30, 2))
    np.testing.assert_allclose(KNNTD("MountainCar-v0", points=places).policy.points.numpy(), places)


def test_device_auto(make_model: MakeModel) -> None:
    model = make_model(device="auto").learn(20)
    assert model.policy.q_table.device == model.device


def test_learn_returns_the_model(make_model: MakeModel) -> None:
    model = make_model()
    assert model.learn(10) is model


@TD_ONLY
def test_initial_value(make_model: MakeModel) -> None:
    assert (make_model(initial_value=-3.5).policy.q_table == -3.5).all()


# ----------------------------------------------------------- training again


def test_continued_learning_keeps_the_count_and_the_table(make_model: MakeModel) -> None:
    model = make_model().learn(100)
    table = model.policy.q_table.clone()
    model.learn(0, reset_num_timesteps=False)
    assert th.equal(model.policy.q_table, table)
    model.learn(50, reset_num_timesteps=False)
    assert model.num_timesteps == 150
    assert not th.equal(model.policy.q_table, table)


def test_continued_learning_stays_in_the_episode(make_model: MakeModel) -> None:
    # The first episode has nine steps, also over several calls.
    model = make_model().learn(4).learn(5, reset_num_timesteps=False)
    assert [info["l"] for info in model.ep_info_buffer or ()] == [9]


@TD_ONLY
def test_new_learning_resets_the_count_and_episodes_but_not_the_table(make_model: MakeModel) -> None:
    model = make_model(learning_rate=0.0, initial_value=2.0).learn(4)
    model.policy.q_table[0, 0] = 5.0
    model.learn(14)
    assert model.num_timesteps == 14
    assert [info["l"] for info in model.ep_info_buffer or ()] == [14]
    assert model.policy.q_table[0, 0] == 5.0


@TD_ONLY
@pytest.mark.parametrize("n_envs", [1, 3])
def test_traces_do_not_outlive_a_reset(algorithm: Algorithm, make_grid: MakeGrid, n_envs: int) -> None:
    # With λ = γ = 1 every error updates all states visited since the traces were cleared.
    venv = DummyVecEnv([lambda: make_grid(lengths=[100])] * n_envs)
    model = algorithm(
        venv, gamma=1.0, trace_decay=1.0, learning_rate=0.5, exploration_initial_eps=0.0, tie_break="first"
    )
    model.learn(3 * n_envs)
    before = model.policy.q_table.clone()
    first_episode = before.any(dim=1)
    model.learn(1 * n_envs)
    changed = (model.policy.q_table != before).any(dim=1)
    assert int(first_episode.sum()) == 3
    # One step of the second episode changes one state.
    assert int(changed.sum()) == 1


# ------------------------------------------------------ environments and seeds


def test_get_and_set_env(make_model: MakeModel, make_venv: MakeVenv) -> None:
    first, second = make_venv(), make_venv()
    model = make_model(first).learn(30)
    assert model.get_env() is first
    model.set_env(second)
    assert model.get_env() is second
    # The new environment is in its first episode of nine steps.
    model.learn(9, reset_num_timesteps=False)
    assert model.num_timesteps == 39
    assert [info["l"] for info in model.ep_info_buffer or ()][-1] == 9


def test_set_env_wraps(env_cls: type[DriftEnv], make_model: MakeModel) -> None:
    model = make_model()
    model.set_env(env_cls())
    assert isinstance(model.get_env(), VecEnv)
    assert model.learn(20).num_timesteps == 20


def test_set_env_refuses_what_does_not_fit(make_model: MakeModel, make_venv: MakeVenv) -> None:
    model = make_model()
    with pytest.raises(ValueError, match="space"):
        model.set_env(GridEnv())
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(make_venv(2))


def test_env_is_made_from_its_id(algorithm: Algorithm, mountain_car: str) -> None:
    model = algorithm(mountain_car, seed=0)
    venv = model.get_env()
    assert isinstance(venv, VecEnv)
    assert venv.num_envs == 1
    assert model.learn(50).num_timesteps == 50


def test_model_without_environment_is_made_but_not_built(algorithm: Algorithm) -> None:
    model = algorithm("KNNPolicy", env=None, _init_setup_model=False)
    assert model.get_env() is None


def test_building_without_environment_says_what_is_missing(algorithm: Algorithm) -> None:
    with pytest.raises(ValueError, match="env"):
        algorithm()


def test_set_random_seed_seeds_the_spaces(make_model: MakeModel) -> None:
    model = make_model()
    draws = []
    for _ in range(2):
        model.set_random_seed(11)
        draws.append([*(model.action_space.sample() for _ in range(10)), *np.random.random(3)])
    assert draws[0] == draws[1]


@pytest.mark.parametrize("seed", [0, None])
def test_set_random_seed_may_be_called_at_any_time(make_model: MakeModel, seed: int | None) -> None:
    model = make_model().learn(30)
    model.set_random_seed(seed)
    assert model.learn(30, reset_num_timesteps=False).num_timesteps == 60


def test_set_logger(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    logger = configure(str(tmp_path), ["csv"])
    model = make_model()
    model.set_logger(logger)
    model.learn(60)
    assert model.logger is logger
    assert (tmp_path / "progress.csv").stat().st_size > 0


# --------------------------------------------------------------- parameters


def test_parameters_go_from_model_to_model(make_model: MakeModel, observations: np.ndarray) -> None:
    learned, other = make_model().learn(150), make_model(seed=1)
    assert not th.equal(other.policy.q_table, learned.policy.q_table)
    other.set_parameters(learned.get_parameters())
    assert th.equal(other.policy.q_table, learned.policy.q_table)
    assert th.equal(other.policy.q_values(observations), learned.policy.q_values(observations))
    # It is a copy: later learning of one model does not affect the other.
    other.learn(50)
    assert not th.equal(other.policy.q_table, learned.policy.q_table)


def test_parameters_go_through_a_file(make_model: MakeModel, tmp_path: pathlib.Path) -> None:
    learned, other = make_model().learn(150), make_model(seed=1)
    learned.save(tmp_path / "model")
    other.set_parameters(str(tmp_path / "model"), device="cpu")
    assert th.equal(other.policy.q_table, learned.policy.q_table)


def test_parameters_hold_the_ranges(algorithm: Algorithm, cart_pole: str) -> None:
    arguments = fitting(algorithm, {"points": 3, "n_neighbors": 2})
    measured, other = (algorithm(cart_pole, seed=seed, **arguments) for seed in (0, 1))
    measured.learn(1050)
    other.set_parameters(measured.get_parameters())
    assert th.equal(other.policy.points, measured.policy.points)
    places = np.float32([[0.1, 0.2, 0.05, -0.3]])
    assert th.equal(other.policy.q_values(places), measured.policy.q_values(places))


def test_parameters_that_do_not_fit_are_refused(make_model: MakeModel) -> None:
    model = make_model()
    parameters = model.get_parameters()
    with pytest.raises(ValueError, match="Names of parameters"):
        model.set_parameters({})
    with pytest.raises(ValueError, match="invalid object name"):
        model.set_parameters({**parameters, "no_such_part": {}})


@TD_ONLY
def test_parameters_of_other_points_are_refused(make_model: MakeModel) -> None:
    with pytest.raises(RuntimeError, match="size mismatch"):
        make_model().set_parameters(make_model(points=(3, 3)).get_parameters())


def test_parameters_are_loaded_without_running_code(make_model: MakeModel) -> None:
    model, memory = make_model().learn(100), io.BytesIO()
    th.save(model.get_parameters(), memory)
    memory.seek(0)
    other = make_model(seed=1)
    other.set_parameters(th.load(memory, weights_only=True))
    assert th.equal(other.policy.q_table, model.policy.q_table)


# --------------------------------------------------------------- evaluation


def test_evaluate_policy_equals_a_loop_by_hand(env_cls: type[DriftEnv], make_model: MakeModel) -> None:
    model = make_model().learn(200)
    env = env_cls()
    by_hand = []
    for _ in range(3):
        observation, _ = env.reset()
        total, done = 0.0, False
        while not done:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, done = total + reward, terminated or truncated
        by_hand.append(total)
    mean, _ = evaluate_policy(model, env_cls(), n_eval_episodes=3, deterministic=True, warn=False)
    assert mean == pytest.approx(np.mean(by_hand), rel=1e-5)


def test_evaluation_in_between_changes_nothing_that_is_learned(make_model: MakeModel, make_venv: MakeVenv) -> None:
    model = make_model().learn(60)
    evaluate_policy(model, make_venv(), n_eval_episodes=3)
    model.learn(60, reset_num_timesteps=False)
    undisturbed = make_model().learn(60).learn(60, reset_num_timesteps=False)
    assert th.equal(model.policy.q_table, undisturbed.policy.q_table)
