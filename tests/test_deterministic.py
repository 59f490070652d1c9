"""The same seed gives the same table bit for bit, another seed a different one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from algorithms import ALGORITHMS, TD_ONLY, BoxDyna, fitting
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_knntd import KNNTD, ExA, KNNDyna
from sb3_knntd.common.random_stream import RandomStream

Algorithm = type[KNNTD | ExA | KNNDyna]
MakeModel = Callable[..., KNNTD | ExA | KNNDyna]
MakeVenv = Callable[..., VecEnv]


@pytest.fixture(params=ALGORITHMS)
def algorithm(request: pytest.FixtureRequest) -> Algorithm:
    chosen: Algorithm = request.param
    return chosen


EXPLORING: dict[str, Any] = {"exploration_initial_eps": 0.5, "exploration_fraction": 1.0}
GREEDY: dict[str, Any] = {"exploration_initial_eps": 0.0, "tie_break": "random"}
CHANCE = [
    pytest.param(KNNTD, EXPLORING, id="KNNTD-epsilon"),
    pytest.param(KNNTD, {"exploration": "softmax"}, id="KNNTD-softmax"),
    pytest.param(KNNTD, GREEDY, id="KNNTD-random ties"),
    pytest.param(ExA, EXPLORING, id="ExA-shared"),
    pytest.param(ExA, {**EXPLORING, "exploration": "per_neighbor"}, id="ExA-per neighbor"),
    pytest.param(ExA, GREEDY, id="ExA-random ties"),
    pytest.param(KNNDyna, {}, id="KNNDyna"),
    pytest.param(BoxDyna, {}, id="KNNDyna-Box"),
]


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(("algorithm", "settings"), CHANCE)
def test_seeds(make_model: MakeModel, make_venv: MakeVenv, settings: dict[str, Any], n_envs: int) -> None:
    # The environments are deterministic: only the random numbers of the model differ.
    first, second, other = (make_model(make_venv(n_envs), seed=seed, **settings).learn(150) for seed in (5, 5, 6))
    assert th.equal(first.policy.q_table, second.policy.q_table)
    assert not th.equal(first.policy.q_table, other.policy.q_table)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_environments_are_seeded(algorithm: Algorithm, mountain_car: str, n_envs: int) -> None:
    def learn(seed: int) -> th.Tensor:
        venv = make_vec_env(lambda: gym.make(mountain_car, max_episode_steps=25), n_envs)
        # Only the initial states are random.
        arguments = {"points": 8, "n_neighbors": 4, "exploration_initial_eps": 0.0, "tie_break": "first", "seed": seed}
        model = algorithm(venv, **fitting(algorithm, arguments))
        return model.learn(120).policy.q_table

    assert th.equal(learn(1), learn(1))
    assert not th.equal(learn(1), learn(2))


def test_no_seed_no_repetition(make_model: MakeModel) -> None:
    first, second = (make_model(seed=None, exploration_initial_eps=0.5).learn(150) for _ in range(2))
    assert not th.equal(first.policy.q_table, second.policy.q_table)


def test_without_a_seed_global_generators_do_not_matter(make_model: MakeModel) -> None:
    tables = []
    for _ in range(2):
        np.random.seed(0)
        th.manual_seed(0)
        tables.append(make_model(seed=None, exploration_initial_eps=0.5).learn(150).policy.q_table)
    assert not th.equal(*tables)


def test_other_users_of_the_global_generators_do_not_matter(make_model: MakeModel) -> None:
    def draw(*_: Any) -> bool:
        np.random.random()
        th.rand(1)
        return True

    alone, beside = make_model().learn(150), make_model().learn(150, callback=draw)
    assert th.equal(alone.policy.q_table, beside.policy.q_table)


def test_set_random_seed_restarts_the_sequence(make_model: MakeModel) -> None:
    reseeded = make_model(seed=1, **EXPLORING)
    reseeded.set_random_seed(5)
    assert th.equal(reseeded.learn(150).policy.q_table, make_model(seed=5, **EXPLORING).learn(150).policy.q_table)


def test_the_vec_env_class_does_not_matter(make_model: MakeModel, make_venv: MakeVenv) -> None:
    dummy, subproc = (make_model(make_venv(2, kind)).learn(120) for kind in (DummyVecEnv, SubprocVecEnv))
    assert dummy.policy.q_table.any()
    # DummyVecEnv rounds rewards to float32; SubprocVecEnv does not.
    th.testing.assert_close(dummy.policy.q_table, subproc.policy.q_table, rtol=1e-5, atol=1e-5)


@TD_ONLY
def test_tie_break_first_without_exploration_is_deterministic(make_model: MakeModel) -> None:
    settings = {"exploration_initial_eps": 0.0, "tie_break": "first"}
    first, second = (make_model(seed=seed, **settings).learn(150) for seed in (1, 2))
    assert th.equal(first.policy.q_table, second.policy.q_table)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_without_schedules_total_timesteps_do_not_matter(
    make_model: MakeModel, make_venv: MakeVenv, n_envs: int
) -> None:
    settings = {"exploration_initial_eps": 0.3, "exploration_final_eps": 0.3}
    at_once = make_model(make_venv(n_envs), **settings).learn(150)
    in_parts = make_model(make_venv(n_envs), **settings).learn(60).learn(90, reset_num_timesteps=False)
    assert th.equal(at_once.policy.q_table, in_parts.policy.q_table)


@given(
    shape=st.lists(st.integers(1, 4), min_size=1, max_size=3).map(tuple) | st.just((2**18,)),
    before=st.integers(0, 9),
    after=st.integers(1, 9),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=25, deadline=None)
def test_a_stream_continues_from_a_saved_position(shape: tuple[int, ...], before: int, after: int, seed: int) -> None:
    """For any row width, which determines how many rows are generated at a time."""
    stream, other = RandomStream(shape), RandomStream(shape)
    stream.seed(seed)
    for _ in range(before):
        stream.next()
    other.set_state(stream.state())
    for _ in range(after):
        row = stream.next().copy()
        assert row.shape == shape
        np.testing.assert_array_equal(other.next(), row)
    assert stream.state() == other.state() == {"key": stream.state()["key"], "position": before + after}
    assert stream.rows.nbytes <= max(8 * 2**20, row.nbytes)
