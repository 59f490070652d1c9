"""Supported spaces, their points, and the errors for unsupported ones."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_knntd import KNNTD


class SpaceEnv(gym.Env[Any, Any]):
    """Random observations from a space, a reward of 1, and episodes of ten steps."""

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any] | None = None) -> None:
        self.observation_space = observation_space
        self.action_space = spaces.Discrete(2) if action_space is None else action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.elapsed = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), f"{action!r} is no action"
        self.elapsed += 1
        return self.observation_space.sample(), 1.0, self.elapsed == 10, False, {}


def box(low: Any, high: Any, dtype: Any = np.float32) -> spaces.Box:
    return spaces.Box(np.array(low, dtype=dtype), np.array(high, dtype=dtype), dtype=dtype)


# ---------------------------------------------------------------------- Box


@pytest.mark.parametrize(
    "dtype",
    ["float16", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"],
)
@pytest.mark.parametrize("obs_dim", [1, 2, 3])
def test_boxes_of_any_number_type(dtype: str, obs_dim: int) -> None:
    env = SpaceEnv(box([0] * obs_dim, [100] * obs_dim, np.dtype(dtype)))
    model = KNNTD(env, points=3, n_neighbors=2, seed=0).learn(30)
    assert model.policy.q_table.dtype == th.float64
    assert model.policy.q_table.any()
    points = model.policy.points.numpy()
    assert points.shape == (3**obs_dim, obs_dim)
    assert (points.min(), points.max()) == (0.0, 100.0)
    observation = env.observation_space.sample()
    assert env.action_space.contains(model.predict(observation, deterministic=True)[0])
    # The same observation in other dtypes.
    as_float = np.asarray(observation, dtype=np.float64)
    assert th.equal(model.policy.q_values(observation), model.policy.q_values(as_float))


def test_the_dtype_does_not_matter() -> None:
    tables = []
    for dtype in (np.uint8, np.int64, np.float32, np.float64):
        env = gym.wrappers.TransformObservation(
            SpaceEnv(box([0, 0], [200, 200], np.uint8)),
            lambda observation, dtype=dtype: observation.astype(dtype),
            box([0, 0], [200, 200], dtype),
        )
        tables.append(KNNTD(env, points=4, n_neighbors=4, seed=0).learn(60).policy.q_table)
    assert tables[0].any()
    assert all(th.equal(table, tables[0]) for table in tables)


def test_small_numbers_do_not_overflow() -> None:
    # In int8 arithmetic 127 - -128 is -1.
    model = KNNTD(SpaceEnv(box([-128, -128], [127, 127], np.int8)), points=3, n_neighbors=1, seed=0)
    assert model.policy.perceive(np.array([-128, 127], dtype=np.int8)).indices.tolist() == [[2]]
    assert model.policy.perceive(np.array([127, -128], dtype=np.int8)).indices.tolist() == [[6]]


# ------------------------------------------------- Discrete and MultiDiscrete

EXACT: dict[str, tuple[spaces.Space[Any], list[Any]]] = {
    "Discrete": (spaces.Discrete(5), [0, 1, 2, 3, 4]),
    "Discrete, one state": (spaces.Discrete(1), [0]),
    "Discrete from 7": (spaces.Discrete(3, start=7), [7, 8, 9]),
    "Discrete from -2": (spaces.Discrete(4, start=-2), [-2, -1, 0, 1]),
    "MultiDiscrete": (spaces.MultiDiscrete([2, 3]), [[i, j] for i in range(2) for j in range(3)]),
    "MultiDiscrete, one axis of one": (spaces.MultiDiscrete([1, 3]), [[0, 0], [0, 1], [0, 2]]),
    "MultiDiscrete from elsewhere": (
        spaces.MultiDiscrete([2, 2], start=[3, -1]),
        [[3, -1], [3, 0], [4, -1], [4, 0]],
    ),
}


@pytest.mark.parametrize(("space", "states"), EXACT.values(), ids=EXACT)
def test_one_point_a_state(space: spaces.Space[Any], states: list[Any]) -> None:
    policy = KNNTD(SpaceEnv(space), seed=0).policy
    assert policy.q_table.shape == (len(states), 2)
    assert policy.points.numpy().reshape(np.shape(states)).tolist() == states
    for number, state in enumerate(states):
        indices, probabilities = policy.perceive(np.array(state))
        assert indices.tolist() == [[number]]
        assert probabilities.tolist() == [[1.0]]


@pytest.mark.parametrize(("space", "states"), EXACT.values(), ids=EXACT)
def test_one_step_changes_one_entry_by_the_equation(space: spaces.Space[Any], states: list[Any]) -> None:
    env = SpaceEnv(space)
    model = KNNTD(env, learning_rate=0.25, gamma=0.5, initial_value=8.0, seed=0)
    seen: list[Any] = []

    def watch(local: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append(int(local["actions"][0]))
        return True

    start, _ = SpaceEnv(space).reset(seed=0)
    model.learn(1, callback=watch)
    expected = th.full((len(states), 2), 8.0, dtype=th.float64)
    # Q + α (r + γ Q' - Q) with Q = Q' = 8 and r = 1
    expected[states.index(np.asarray(start).tolist()), seen[0]] += 0.25 * (1.0 + 0.5 * 8.0 - 8.0)
    assert th.equal(model.policy.q_table, expected)


@pytest.mark.parametrize(("space", "states"), EXACT.values(), ids=EXACT)
def test_exact_tables_predict(space: spaces.Space[Any], states: list[Any]) -> None:
    model = KNNTD(SpaceEnv(space), seed=0)
    best = np.arange(len(states)) % 2
    model.policy.q_table[th.arange(len(states)), th.from_numpy(best)] = 1.0
    assert model.predict(np.array(states), deterministic=True)[0].tolist() == best.tolist()
    model.learn(30)
    assert model.num_timesteps == 30


@pytest.mark.parametrize("arguments", [{"n_neighbors": 1}, {"points": "auto"}, {"bounds": None}])
def test_finite_states_accept_equivalent_arguments(arguments: dict[str, Any]) -> None:
    assert KNNTD(SpaceEnv(spaces.Discrete(5)), **arguments).policy.q_table.shape == (5, 2)


@pytest.mark.parametrize(
    "space",
    [spaces.Discrete(5), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3)],
    ids=["Discrete", "MultiDiscrete", "MultiBinary"],
)
@pytest.mark.parametrize("arguments", [{"n_neighbors": 2}, {"points": 4}, {"bounds": ([0], [1])}])
def test_finite_states_refuse_perception_arguments(space: spaces.Space[Any], arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(arguments))):
        KNNTD(SpaceEnv(space), **arguments)


# ------------------------------------------------------------------ refusals

OBSERVATIONS: dict[str, tuple[spaces.Space[Any], str]] = {
    "image": (spaces.Box(0, 255, (8, 8, 3), np.uint8), "FlattenObservation"),
    "matrix": (spaces.Box(0.0, 1.0, (3, 3)), "FlattenObservation"),
    "number": (spaces.Box(0.0, 1.0, ()), "shape (n,)"),
    "nothing": (spaces.Box(0.0, 1.0, (0,)), "shape (n,)"),
    "Dict": (spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Box(0.0, 1.0, (2,))}), "FlattenObservation"),
    "Tuple": (spaces.Tuple((spaces.Discrete(2), spaces.Discrete(2))), "FlattenObservation"),
    "MultiBinary of two axes": (spaces.MultiBinary([2, 3]), "one axis"),
    "MultiDiscrete of two axes": (spaces.MultiDiscrete(np.full((2, 2), 3)), "one axis"),
    "Text": (spaces.Text(5), "Box"),
}


@pytest.mark.parametrize(("space", "advice"), OBSERVATIONS.values(), ids=OBSERVATIONS)
def test_other_observations_are_refused_with_advice(space: spaces.Space[Any], advice: str) -> None:
    with pytest.raises(ValueError, match=re.escape(advice)) as error:
        KNNTD(SpaceEnv(space))
    assert type(space).__name__ in str(error.value)
    assert "observation" in str(error.value)


@pytest.mark.parametrize("name", ["matrix", "Dict", "Tuple"])
def test_advice_to_flatten_helps(name: str) -> None:
    env = gym.wrappers.FlattenObservation(SpaceEnv(OBSERVATIONS[name][0]))
    assert KNNTD(env, points=2, n_neighbors=2).learn(20).num_timesteps == 20


ACTIONS: dict[str, tuple[spaces.Space[Any], str]] = {
    "Box": (spaces.Box(-1.0, 1.0, (2,)), "ExA"),
    "MultiDiscrete": (spaces.MultiDiscrete([2, 3]), "ActionWrapper"),
    "MultiBinary": (spaces.MultiBinary(3), "ActionWrapper"),
    "Dict": (spaces.Dict({"a": spaces.Discrete(2)}), "Discrete"),
    "Tuple": (spaces.Tuple((spaces.Discrete(2),)), "Discrete"),
}


@pytest.mark.parametrize(("space", "advice"), ACTIONS.values(), ids=ACTIONS)
def test_other_actions_are_refused_with_advice(space: spaces.Space[Any], advice: str) -> None:
    with pytest.raises(ValueError, match=advice) as error:
        KNNTD(SpaceEnv(spaces.Discrete(3), space))
    assert type(space).__name__ in str(error.value)
    assert "action" in str(error.value)


def test_spaces_of_a_vec_env_are_checked_too() -> None:
    with pytest.raises(ValueError, match="ExA"):
        KNNTD(DummyVecEnv([lambda: SpaceEnv(spaces.Discrete(3), spaces.Box(-1.0, 1.0, (1,)))]))


# ------------------------------------------------------- unbounded dimensions


class Wave(gym.Env[Any, Any]):
    """Oscillates in [-3, 5] in one dimension and in [0, 1] in another, with a reward of 1."""

    def __init__(self, low: Any, high: Any, dtype: Any = np.float64) -> None:
        self.observation_space = box(low, high, dtype)
        self.action_space = spaces.Discrete(2)
        self.elapsed = 0

    def observe(self) -> Any:
        phase = self.elapsed / 10
        place = np.array([1.0 + 4.0 * np.sin(phase), 0.5 + 0.5 * np.cos(phase)])
        return place.astype(self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.elapsed += 1
        return self.observe(), 1.0, False, self.elapsed % 100 == 0, {}


def range_of(model: KNNTD) -> tuple[np.ndarray, np.ndarray]:
    points = model.policy.points.numpy()
    return points.min(axis=0), points.max(axis=0)


@pytest.mark.parametrize(
    ("low", "high", "dtype"),
    [
        ([-np.inf, 0.0], [np.inf, 1.0], np.float64),
        ([-10.0, 0.0], [np.inf, 1.0], np.float32),
        ([-np.inf, 0.0], [10.0, 1.0], np.float64),
        ([-3.4e38, 0.0], [3.4e38, 1.0], np.float32),
        ([np.iinfo(np.int64).min, 0], [np.iinfo(np.int64).max, 1], np.int64),
    ],
    ids=["unbounded", "above", "below", "absurd", "integers"],
)
def test_only_dimensions_without_a_range_are_measured(low: Any, high: Any, dtype: Any) -> None:
    model = KNNTD(Wave(low, high, dtype), points=5, n_neighbors=4, seed=0)
    model.learn(1100)
    lowest, highest = range_of(model)
    # The observed range is inside, and not much more.
    assert -7.0 <= lowest[0] <= -3.0 + (dtype is np.int64)
    assert 5.0 - (dtype is np.int64) <= highest[0] <= 9.0
    # The other dimension keeps its range.
    assert (lowest[1], highest[1]) == (0.0, 1.0)
    assert model.policy.q_table.any()


def test_measuring_steps_count_but_are_not_learned_from() -> None:
    model = KNNTD(Wave([-np.inf, 0.0], [np.inf, 1.0]), points=5, n_neighbors=4, seed=0)
    model.learn(500)
    assert model.num_timesteps == 500
    assert not model.policy.q_table.any()
    model.learn(700, reset_num_timesteps=False)
    assert model.num_timesteps == 1200
    assert model.policy.q_table.any()


def test_range_is_measured_once() -> None:
    model = KNNTD(Wave([-np.inf, 0.0], [np.inf, 1.0]), points=5, n_neighbors=4, seed=0).learn(1100)
    lowest, highest = range_of(model)
    # The rows of a table keep their meaning, and a second call learns from its first step on.
    before = model.policy.q_table.clone()
    model.learn(20)
    assert (range_of(model)[0] == lowest).all()
    assert (range_of(model)[1] == highest).all()
    assert not th.equal(model.policy.q_table, before)


def test_given_bounds_are_not_measured() -> None:
    model = KNNTD(
        Wave([-np.inf, 0.0], [np.inf, 1.0]), bounds=([-2.0, 0.0], [2.0, 1.0]), points=5, n_neighbors=4, seed=0
    ).learn(20)
    assert model.policy.q_table.any(), "learning waits for nothing"
    assert range_of(model)[0].tolist() == [-2.0, 0.0]
    assert range_of(model)[1].tolist() == [2.0, 1.0]


@pytest.mark.parametrize(("verbose", "lines"), [(0, 0), (1, 1)])
def test_one_line_says_which_range_was_taken(capsys: pytest.CaptureFixture[str], verbose: int, lines: int) -> None:
    env = DummyVecEnv([lambda: Wave([-np.inf, 0.0], [np.inf, 1.0])])
    KNNTD(env, points=5, n_neighbors=4, seed=0, verbose=verbose).learn(1100, log_interval=None)
    printed = [line for line in capsys.readouterr().out.splitlines() if "ange" in line]
    assert len(printed) == lines
    for line in printed:
        low, high = map(float, re.findall(r"\[(.+), (.+)\]", line)[0])
        assert low <= -3.0 < 5.0 <= high


def test_prediction_before_measuring() -> None:
    model = KNNTD("CartPole-v1", points=3, n_neighbors=2)
    assert model.action_space.contains(model.predict(np.zeros(4, dtype=np.float32))[0])


def test_scattered_points_stay_where_they_are_when_ranges_are_measured() -> None:
    # From (1, 0.5) the second point is nearer in observation units, and the first relative to the ranges of 8 and 1.
    places = np.array([[3.0, 0.5], [1.0, 0.9]])
    model = KNNTD(Wave([-np.inf, 0.0], [np.inf, 1.0]), points=places, n_neighbors=1, seed=0)
    assert model.policy.perceive(np.array([1.0, 0.5])).indices.tolist() == [[1]]
    model.learn(1100)
    np.testing.assert_allclose(model.policy.points.numpy(), places, atol=1e-12)
    assert model.policy.perceive(np.array([1.0, 0.5])).indices.tolist() == [[0]]


def test_a_constant_dimension_is_allowed() -> None:
    env = gym.wrappers.TransformObservation(
        Wave([-np.inf, 0.0], [np.inf, 1.0]),
        lambda observation: np.array([7.0, observation[1]]),
        box([-np.inf, 0.0], [np.inf, 1.0], np.float64),
    )
    model = KNNTD(env, points=5, n_neighbors=4, seed=0).learn(1100)
    assert range_of(model)[0][0] < 7.0 < range_of(model)[1][0]
    assert th.isfinite(model.policy.q_table).all()
    assert model.policy.q_table.any()


EnvMaker = Callable[[], gym.Env[Any, Any]]


@pytest.mark.parametrize("n_envs", [1, 4])
def test_many_environments_measure_together(n_envs: int) -> None:
    makers: list[EnvMaker] = [lambda: Wave([-np.inf, 0.0], [np.inf, 1.0])] * n_envs
    model = KNNTD(DummyVecEnv(makers), points=5, n_neighbors=4, seed=0).learn(1100)
    assert range_of(model)[0][0] <= -3.0
    assert range_of(model)[1][0] >= 5.0
    assert model.policy.q_table.any()
