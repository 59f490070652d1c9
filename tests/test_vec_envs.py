"""Vectorised environments of all kinds, with one or many environments."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS, TD_ONLY, fitting
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)
from toy_envs import DriftEnv

from sb3_knntd import KNNTD, ExA, KNNDyna

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeGrid = Callable[..., gym.Env[Any, Any]]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


def check_learned(model: KNNTD | ExA | KNNDyna, n_steps: int) -> None:
    assert model.num_timesteps == n_steps
    assert model.policy.q_table.any()
    assert th.isfinite(model.policy.q_table).all()


@pytest.mark.parametrize(
    ("vec_env_cls", "n_envs"),
    [(DummyVecEnv, 1), (DummyVecEnv, 2), (DummyVecEnv, 5), (SubprocVecEnv, 2)],
)
def test_learn_and_evaluate(make_model: MakeModel, make_venv: MakeVenv, vec_env_cls: Any, n_envs: int) -> None:
    venv = make_venv(n_envs, vec_env_cls)
    model = make_model(venv).learn(40 * n_envs)
    check_learned(model, 40 * n_envs)
    assert np.isfinite(evaluate_policy(model, venv, n_eval_episodes=3, warn=False)[0])


def test_steps_are_counted_over_all_environments(make_model: MakeModel, make_venv: MakeVenv) -> None:
    # The last step of all environments is completed, as in SB3.
    assert make_model(make_venv(4)).learn(50).num_timesteps == 52


@pytest.mark.parametrize("n_envs", [1, 7])
def test_schedules_stay_within_the_run(make_model: MakeModel, make_venv: MakeVenv, n_envs: int) -> None:
    asked: list[float] = []

    def schedule(progress: float) -> float:
        asked.append(progress)
        return 0.3

    make_model(make_venv(n_envs), learning_rate=schedule).learn(100)
    assert max(asked) <= 1.0
    # Seven environments overshoot a hundred steps; schedules stay at their final value beyond the end.
    assert min(asked) >= 0.0


@TD_ONLY
def test_a_learning_rate_decreasing_to_0_is_never_negative(make_model: MakeModel, make_venv: MakeVenv) -> None:
    # A step of 50 environments for 10 requested steps: the remaining progress would be -4.
    model = make_model(make_venv(50), learning_rate=lambda progress: progress, initial_value=0.0)
    model.learn(10)
    assert not model.policy.q_table.any()


@TD_ONLY
def test_environments_share_one_table(make_model: MakeModel, make_venv: MakeVenv) -> None:
    model = make_model(make_venv(6)).learn(6)
    # Six first steps from different states update more points than a single step.
    assert int(model.policy.q_table.any(dim=1).sum()) > 4


@TD_ONLY
def test_many_equal_environments_learn_as_stably_as_one(env_cls: type[DriftEnv], make_model: MakeModel) -> None:
    settings = {"exploration_initial_eps": 0.0, "tie_break": "first"}
    one = make_model(DummyVecEnv([env_cls]), **settings).learn(60)
    # Sixty-four equal transitions must not make the update sixty-four times as large.
    many = make_model(DummyVecEnv([env_cls] * 64), **settings).learn(60 * 64)
    th.testing.assert_close(many.policy.q_table, one.policy.q_table)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_frame_stack(algorithm: Algorithm, make_venv: MakeVenv, n_envs: int) -> None:
    venv = VecFrameStack(make_venv(n_envs), n_stack=2)
    low, high = np.tile(DriftEnv.LOW, 2), np.tile(DriftEnv.HIGH, 2)
    model = algorithm(venv, **fitting(algorithm, {"points": 4, "bounds": (low, high), "seed": 0})).learn(60 * n_envs)
    check_learned(model, 60 * n_envs)
    assert model.policy.points.shape[1] == 4
    assert model.predict(venv.reset())[0].shape == (n_envs, *(venv.action_space.shape or ()))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_monitor(env_cls: type[DriftEnv], make_model: MakeModel, n_envs: int) -> None:
    model = make_model(VecMonitor(DummyVecEnv([env_cls] * n_envs))).learn(30 * n_envs)
    check_learned(model, 30 * n_envs)
    assert [info["l"] for info in model.ep_info_buffer or ()] == [9] * n_envs + [14] * n_envs + [6] * n_envs


def test_check_nan(make_model: MakeModel, make_venv: MakeVenv) -> None:
    check_learned(make_model(VecCheckNan(make_venv(2), raise_exception=True)).learn(60), 60)


# -------------------------------------------------------------- VecNormalize


@pytest.mark.parametrize("n_envs", [1, 3])
def test_normalised_observations_are_measured(algorithm: Algorithm, make_venv: MakeVenv, n_envs: int) -> None:
    venv = VecNormalize(make_venv(n_envs))
    model = algorithm(venv, **fitting(algorithm, {"points": 5, "seed": 0})).learn(1300)
    check_learned(model, 1300 + -1300 % n_envs)
    assert model.get_vec_normalize_env() is venv
    # The space gives ±3 and ±1, but observations are normalised: the points follow the measured range.
    seen = [venv.reset()]
    for _ in range(30):
        seen.append(venv.step(np.stack([venv.action_space.sample()] * n_envs))[0])
    low, high = model.policy.points.amin(dim=0).numpy(), model.policy.points.amax(dim=0).numpy()
    inside = np.mean((np.concatenate(seen) >= low) & (np.concatenate(seen) <= high))
    assert inside > 0.9
    assert (high - low < 12).all()


@TD_ONLY
def test_normalised_rewards_alone_leave_the_space_its_range(algorithm: Algorithm, make_venv: MakeVenv) -> None:
    venv = VecNormalize(make_venv(), norm_obs=False)
    model = algorithm(venv, points=5, seed=0)
    points = model.policy.points.clone()
    model.learn(60)
    check_learned(model, 60)
    assert th.equal(model.policy.points, points)
    np.testing.assert_allclose(points.amax(dim=0).numpy(), [3.0, 1.0])


@TD_ONLY
def test_given_bounds_are_those_of_normalised_observations(algorithm: Algorithm, make_venv: MakeVenv) -> None:
    model = algorithm(VecNormalize(make_venv()), points=5, bounds=([-2, -2], [2, 2]), seed=0).learn(60)
    check_learned(model, 60)
    np.testing.assert_allclose(model.policy.points.amax(dim=0).numpy(), [2.0, 2.0])


@TD_ONLY
def test_truncation_bootstraps_from_the_normalised_last_observation(
    algorithm: Algorithm, env_cls: type[DriftEnv]
) -> None:
    # In an episode of a single truncated step the target is r + γ Q(s'), with Q(s') = 10 everywhere.
    venv = VecNormalize(make_vec_env(lambda: env_cls(lengths=[1], ends=["truncated"]), 1), norm_reward=False)
    model = algorithm(
        venv, points=1, bounds=([-2, -2], [2, 2]), n_neighbors=1, learning_rate=1.0, gamma=0.5, initial_value=10.0
    )
    rewards: list[float] = []
    model.learn(1, callback=lambda local, _: rewards.append(float(local["rewards"][0])) or True)
    assert float(model.policy.q_table.min()) == pytest.approx(rewards[0] + 5.0)


def test_normalisation_is_saved_beside(algorithm: Algorithm, make_venv: MakeVenv, tmp_path: pathlib.Path) -> None:
    venv = VecNormalize(make_venv(2))
    model = algorithm(venv, **fitting(algorithm, {"points": 5, "seed": 0})).learn(1200)
    model.save(tmp_path / "model")
    venv.save(str(tmp_path / "normalize.pkl"))

    again = VecNormalize.load(str(tmp_path / "normalize.pkl"), make_venv(2))
    loaded = algorithm.load(tmp_path / "model", env=again)
    assert th.equal(loaded.policy.points, model.policy.points)
    places = np.float32([[0.0, 0.0], [0.3, -0.01], [-0.8, 0.02]])
    normalised = venv.normalize_obs(places)
    assert np.array_equal(again.normalize_obs(places), normalised)
    assert th.equal(loaded.policy.q_values(normalised), model.policy.q_values(normalised))
    loaded.learn(100, reset_num_timesteps=False)
    if not loaded.policy.grows:
        # The ranges are measured only once.
        assert th.equal(loaded.policy.points, model.policy.points)
    assert not th.equal(loaded.policy.q_table, model.policy.q_table)


# ----------------------------------------------------- episodes and their ends


class Still(gym.Env[Any, Any]):
    """Stays in its state, with a reward of 1 per step."""

    def __init__(self, place: list[float], length: int, env_cls: type[DriftEnv]) -> None:
        self.place = np.array(place, dtype=np.float32)
        self.length = length
        self.observation_space = env_cls().observation_space
        self.action_space = env_cls().action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.elapsed = 0
        return self.place, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.elapsed += 1
        return self.place, 1.0, self.elapsed >= self.length, False, {}


@TD_ONLY
def test_the_end_of_one_episode_does_not_affect_the_others(env_cls: type[DriftEnv], make_model: MakeModel) -> None:
    def venv() -> VecEnv:
        # Two distant corners, so that the environments share no points; the first one ends at every step.
        return DummyVecEnv(
            [lambda: Still([-0.9, -0.04], 1, env_cls), lambda: Still([0.4, 0.05], 100, env_cls)],
        )

    settings = {"exploration_initial_eps": 0.0, "tie_break": "first", "gamma": 0.9}
    both = make_model(venv(), **settings).learn(40)
    alone = make_model(DummyVecEnv([lambda: Still([0.4, 0.05], 100, env_cls)]), **settings).learn(20)
    place = np.float32([0.4, 0.05])
    th.testing.assert_close(both.policy.q_values(place), alone.policy.q_values(place))
    assert alone.policy.q_values(place).any()


@TD_ONLY
@pytest.mark.parametrize(("end", "value"), [("terminated", 1.0), ("truncated", 1.0 + 0.5 * 10.0)])
def test_value_at_the_end_of_an_episode(algorithm: Algorithm, env_cls: type[DriftEnv], end: str, value: float) -> None:
    env = gym.wrappers.TransformReward(env_cls(lengths=[1], ends=[end]), lambda _: 1.0)
    model = algorithm(env, points=1, n_neighbors=1, learning_rate=1.0, gamma=0.5, initial_value=10.0).learn(1)
    assert float(model.policy.q_table.min()) == pytest.approx(value)


@pytest.mark.parametrize(
    ("vec_env_cls", "kind"),
    [(DummyVecEnv, "discrete"), (DummyVecEnv, "multi_discrete"), (SubprocVecEnv, "multi_discrete")],
)
def test_exact_tables_of_many_environments(
    algorithm: Algorithm, make_grid: MakeGrid, vec_env_cls: Any, kind: str
) -> None:
    venv = vec_env_cls([partial(Monitor, make_grid(kind)) for _ in range(2)])
    try:
        check_learned(algorithm(venv, seed=0).learn(100), 100)
    finally:
        venv.close()
