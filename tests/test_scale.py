"""Scaling: hashed tables, exact traces, memory, compilation and many environments."""

from __future__ import annotations

import copy
import json
import os
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from knn_td_from_scratch import NearestPoints
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from toy_envs import GridEnv

from sb3_knntd import KNNTD
from sb3_knntd.kernels import nearest, perceive, selection, state, td, traces
from sb3_knntd.learners import CompiledLearner, TorchLearner
from sb3_knntd.q_table import ActiveTraces, DenseTable, HashedTable


class Walk(gym.Env[np.ndarray, int]):
    """A random walk in a box: the action pushes one dimension, walls stop it.

    :param n_dims: number of dimensions
    :param length: steps per episode
    :param seed: seed of the moves; environments with different seeds differ
    :param stride: size of a step
    :param end: how episodes end, "terminated" or "truncated"
    """

    def __init__(
        self,
        n_dims: int = 2,
        length: int = 40,
        seed: int = 0,
        stride: float = 0.05,
        end: str = "terminated",
        n_actions: int = 3,
    ) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (n_dims,), np.float32)
        self.action_space = spaces.Discrete(n_actions)
        self.length, self.stride, self.end = length, stride, end
        self.moves = np.random.default_rng(seed)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.elapsed = 0
        self.place = self.moves.uniform(-0.9, 0.9, self.observation_space.shape)
        return self.place.astype(np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place = self.place + self.moves.normal(0.0, self.stride, self.place.shape)
        self.place[0] += self.stride * (int(action) - 1)
        self.place = np.clip(self.place, -0.95, 0.95)
        self.elapsed += 1
        reward = -1.0 + float(np.sin(5.0 * self.place[0]) - abs(self.place[-1])) + 0.1 * int(action)
        over = self.elapsed >= self.length
        ends = over and self.end == "terminated", over and self.end == "truncated"
        return self.place.astype(np.float32), reward, *ends, {}


def walks(n_envs: int = 1, **arguments: Any) -> VecEnv:
    """Environments with different dynamics and episode lengths."""
    length, first_seed = arguments.pop("length", 40), arguments.pop("seed", 0)

    def make(number: int) -> Callable[[], gym.Env[Any, Any]]:
        return lambda: Walk(length=length + 3 * number, seed=first_seed + number, **arguments)

    return DummyVecEnv([make(number) for number in range(n_envs)])


def make_model(env: Any, table: str = "auto", dtype: th.dtype = th.float64, **arguments: Any) -> KNNTD:
    """A model without default values for the relevant arguments."""
    policy_kwargs: dict[str, Any] = {"table": table, "dtype": dtype, "compiled": arguments.pop("compiled", True)}
    chosen: dict[str, Any] = {
        "points": (20, 15),
        "n_neighbors": 4,
        "learning_rate": 0.1,
        "gamma": 0.99,
        "trace_decay": 0.9,
        "step_size": "paper",
        "exploration_initial_eps": 0.3,
        "exploration_final_eps": 0.1,
        "tie_break": "first",
        "seed": 0,
    }
    return KNNTD(env, policy_kwargs=policy_kwargs, **{**chosen, **arguments})


def as_dense(model: KNNTD) -> np.ndarray:
    """The values of all points of a dense or hashed table."""
    table = model.policy.table
    n_points = model.policy.perceiver.points.n_points
    rows: np.ndarray = table.rows(th.arange(n_points)[:, None])[:, 0].numpy()
    return rows.copy()


def active_traces(model: KNNTD) -> ActiveTraces:
    assert isinstance(model.learner, CompiledLearner)
    return model.policy.table.traces


# -------------------------------------------------------------------------------------- the hashed table


@pytest.mark.parametrize("n_envs", [1, 5])
@pytest.mark.parametrize("dtype", [th.float64, th.float32])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"traces": "accumulating", "learning_rate": 0.03},
        {"initial_value": -4.0, "target": "q_learning", "reset_other_actions": True},
        {"step_size": "normalized", "target": "expected_sarsa", "trace_decay": 1.0, "gamma": 1.0},
        {"search": "brute"},
        {"search": "kd_tree"},
    ],
    ids=["defaults", "accumulating", "q_learning", "normalized", "brute", "kd_tree"],
)
def test_hashed_learns_what_dense_does(n_envs: int, dtype: th.dtype, settings: dict[str, Any]) -> None:
    dense, hashed = (
        make_model(walks(n_envs), table, dtype, **settings).learn(600 * n_envs) for table in ("dense", "hashed")
    )
    assert isinstance(hashed.policy.table, HashedTable)
    assert isinstance(dense.policy.table, DenseTable)
    assert hashed.policy.q_table.dtype == dtype
    np.testing.assert_array_equal(as_dense(hashed), as_dense(dense))
    observations = np.random.default_rng(0).uniform(-1.1, 1.1, (200, 2)).astype(np.float32)
    assert th.equal(hashed.policy.q_values(observations), dense.policy.q_values(observations))
    for single in (observations, observations[0]):
        np.testing.assert_array_equal(
            hashed.predict(single, deterministic=True)[0], dense.predict(single, deterministic=True)[0]
        )
    assert hashed.policy.table.n_visited == dense.policy.table.n_visited > 100


def test_hashed_learns_what_dense_does_on_discrete_states() -> None:
    dense, hashed = (
        KNNTD(GridEnv(shape=(90, 50)), policy_kwargs={"table": table}, seed=0, exploration_initial_eps=1.0).learn(600)
        for table in ("dense", "hashed")
    )
    np.testing.assert_array_equal(as_dense(hashed), as_dense(dense))
    rows, values = hashed.policy.table.points(), hashed.policy.q_table
    assert rows is not None
    # The index of a state is the state.
    np.testing.assert_array_equal(hashed.policy.points.numpy().round(9), rows.numpy()[:, None])
    assert th.equal(dense.policy.q_table[rows], values)


class VisitedPoints(BaseCallback):
    """The points updated so far, computed by a separate perceiver."""

    def __init__(self, perceiver: NearestPoints) -> None:
        super().__init__()
        self.perceiver = perceiver
        self.points: set[int] = set()
        self.n_rows: list[tuple[int, int]] = []

    def _on_training_start(self) -> None:
        self._add(self.model._last_obs)  # type: ignore[arg-type]

    def _on_step(self) -> bool:
        assert isinstance(self.model, KNNTD)
        self.n_rows.append((len(self.points), self.model.policy.q_table.shape[0]))
        # The current observation is updated in the next step.
        self._add(self.locals["new_obs"])
        return True

    def _add(self, observations: np.ndarray) -> None:
        for observation in observations:
            self.points.update(self.perceiver(observation).indices.tolist())


@pytest.mark.parametrize("n_envs", [1, 3])
def test_rows_are_created_at_the_first_update(n_envs: int) -> None:
    low, high = np.array([-2.0, -1.0]), np.array([1.0, 3.0])
    model = make_model(walks(n_envs), "hashed", bounds=(low, high), points=(9, 7))
    perceiver = NearestPoints((9, 7), (low, high), 4)
    assert model.policy.q_table.shape == (0, 3)
    assert model.policy.points.shape == (0, 2)
    # Reading the values of a point does not create a row.
    model.predict(np.zeros((5, 2), np.float32), deterministic=True)
    assert model.policy.q_table.shape == (0, 3)

    visited = VisitedPoints(perceiver)
    model.learn(100 * n_envs, callback=visited)
    assert all(expected == rows for expected, rows in visited.n_rows)
    assert visited.n_rows[0][1] < visited.n_rows[-1][1] < 63

    rows = model.policy.table.points()
    assert rows is not None
    assert len(set(rows.tolist())) == len(rows)
    assert set(rows.tolist()) <= visited.points
    places = low + 0.5 * (perceiver.points[rows] + 1.0) * (high - low)
    np.testing.assert_allclose(model.policy.points.numpy(), places, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(model.policy.q_table.numpy(), as_dense(model)[rows])
    # All other points have the initial value.
    assert not np.delete(as_dense(model), rows, axis=0).any()


@pytest.mark.parametrize("n_envs", [1, 8])
def test_growth_keeps_everything(n_envs: int) -> None:
    # Some 15,000 rows: from 1024 on the table doubles four times, in the middle of episodes with long traces.
    arguments: dict[str, Any] = {"points": (300, 300), "n_neighbors": 9, "gamma": 1.0, "trace_decay": 1.0}
    arguments |= {"learning_rate": 0.01, "initial_value": 1.0}
    dense, hashed = (
        make_model(walks(n_envs, length=700, stride=0.15), table, **arguments).learn(8000)
        for table in ("dense", "hashed")
    )
    assert hashed.policy.table.n_visited > 8 * HashedTable.SMALLEST
    np.testing.assert_array_equal(as_dense(hashed), as_dense(dense))


@pytest.mark.parametrize("first", [7, 501, 2_003])
def test_a_hashed_table_continues_from_a_file(tmp_path: pathlib.Path, first: int) -> None:
    arguments: dict[str, Any] = {"points": (200, 200), "n_neighbors": 6, "table": "hashed"}
    whole = make_model(walks(stride=0.15), **arguments).learn(first)
    whole.learn(3_000 - first, reset_num_timesteps=False)
    venv = walks(stride=0.15)
    model = make_model(venv, **arguments).learn(first)
    model.save(tmp_path / "model")
    loaded = KNNTD.load(tmp_path / "model", env=venv, force_reset=False)
    assert isinstance(loaded.policy.table, HashedTable)
    assert th.equal(loaded.policy.q_table, model.policy.q_table)
    assert th.equal(loaded.policy.points, model.policy.points)
    loaded.learn(3_000 - first, reset_num_timesteps=False)
    assert loaded.policy.table.n_visited > 2 * HashedTable.SMALLEST
    np.testing.assert_array_equal(as_dense(loaded), as_dense(whole))
    assert th.equal(loaded.policy.points, whole.policy.points)


def test_a_smaller_table_is_loaded_into_a_larger_one() -> None:
    early, late = (
        make_model(walks(stride=0.15), "hashed", points=(200, 200)).learn(n_steps) for n_steps in (50, 3_000)
    )
    assert early.policy.table.n_visited < HashedTable.SMALLEST < late.policy.table.n_visited
    late.set_parameters(early.get_parameters())
    np.testing.assert_array_equal(as_dense(late), as_dense(early))
    assert th.equal(late.policy.points, early.policy.points)
    # New rows are not affected by the previous ones.
    before = set(early.policy.table.points().tolist())  # type: ignore[union-attr]
    visited = VisitedPoints(NearestPoints((200, 200), (-np.ones(2), np.ones(2)), 4))
    late.learn(300, callback=visited)
    rows = late.policy.table.points()
    assert rows is not None
    assert len(set(rows.tolist())) == len(rows) > len(before) + 100
    # The last observation has not been updated.
    assert len(visited.points - set(rows.tolist())) <= 4
    assert set(rows.tolist()) <= visited.points | before


def sizes(model: KNNTD) -> int:
    """Bytes of the table, of the counts of its visits, and of the traces."""
    table, store = model.policy.table, active_traces(model).arrays
    arrays = [array for array in table.arrays() if isinstance(array, np.ndarray)]
    return sum(array.nbytes for array in [*arrays, *store])


def test_a_lattice_of_a_trillion_points_learns() -> None:
    model = make_model(walks(n_dims=12, length=30), points=10, n_neighbors=25)
    assert model.policy.perceiver.points.n_points == 10**12
    used = []
    for _ in range(3):
        model.learn(1_000, reset_num_timesteps=False)
        used.append((model.policy.table.n_visited, sizes(model)))
    assert isinstance(model.policy.table, HashedTable)
    # 12 dims of 25 neighbours: at most that many rows a step, and memory for no more than twice what there is.
    (few, few_bytes), _, (many, many_bytes) = used
    assert 1_000 < few < many <= 25 * 3_000
    per_row = 3 * 8 + 1 + 8 + 4 * 16
    traces = 4 * HashedTable.SMALLEST * (8 + 3 * 3 * 8 + 4 * 16)
    assert few_bytes <= 2 * few * per_row + traces
    assert many_bytes <= 2 * many * per_row + traces

    rows = model.policy.table.points()
    assert rows is not None
    digits = np.array([[int(digit) for digit in f"{row:012d}"] for row in rows.tolist()])
    np.testing.assert_allclose(model.policy.points.numpy(), -1.0 + 2.0 * digits / 9, atol=1e-12)
    # It has learned, and the shown values are those it acts on.
    assert model.policy.q_table.numpy().any(axis=1).mean() > 0.9
    places = model.policy.points[:50].numpy()
    expected = [model.policy.q_table.numpy()[i] for i in range(50)]
    perception = model.policy.perceive(places)
    np.testing.assert_array_equal(perception.indices[:, 0].numpy(), rows[:50].numpy())
    np.testing.assert_array_equal(model.policy.table.rows(perception.indices)[:, 0].numpy(), expected)


def test_auto_selects_the_suitable_table() -> None:
    assert isinstance(make_model(walks(), points=(1000, 1000)).policy.table, DenseTable)
    assert isinstance(make_model(walks(), points=(10_000, 10_000)).policy.table, HashedTable)


# ---------------------------------------------------------------------------------------- exact traces


EPISODES: dict[str, dict[str, Any]] = {
    "one long episode": {"gamma": 1.0, "trace_decay": 0.99},
    "traces that never fade": {"gamma": 1.0, "trace_decay": 1.0},
    # γ λ = 0.891: the decay product reaches 1e-4 and is reset every 80 steps.
    "many restarts of the clock": {"gamma": 0.99, "trace_decay": 0.9},
}


def against_torch(n_steps: int, env: Callable[[], VecEnv], **arguments: Any) -> KNNTD:
    """A compiled run that was checked against the torch operations, which never drop a trace."""
    compiled, torch = (make_model(env(), compiled=flag, **arguments).learn(n_steps) for flag in (True, False))
    assert isinstance(compiled.learner, CompiledLearner)
    assert isinstance(torch.learner, TorchLearner)
    got, expected = compiled.policy.q_table.numpy(), torch.policy.q_table.numpy()
    assert 0.1 < np.abs(expected).max() < 1e5
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)
    return compiled


@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("episode", EPISODES.values(), ids=EPISODES)
def test_long_episodes(episode: dict[str, Any], traces: str) -> None:
    # A trace that accumulates for thousands of steps is large: the step size must be small, or the values diverge.
    learning_rate = 0.02 if traces == "replacing" else 1e-5 if episode["trace_decay"] == 1.0 else 1e-3
    n_steps = 5_000 if traces == "replacing" else 2_000
    against_torch(n_steps, lambda: walks(length=10**9), traces=traces, learning_rate=learning_rate, **episode)


@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("end", ["terminated", "truncated"])
@pytest.mark.parametrize("gamma", [1.0, 0.95])
def test_traces_of_many_environments(end: str, traces: str, gamma: float) -> None:
    # Different episode lengths: the end of an episode must clear only the traces of that environment.
    against_torch(
        16 * 250,
        lambda: walks(16, length=20, end=end),
        gamma=gamma,
        trace_decay=1.0 if gamma == 1.0 else 0.9,
        traces=traces,
        learning_rate=0.02,
        points=(8, 6),
    )


class Alive(BaseCallback):
    """The number of points with a trace, and the capacity."""

    def _init_callback(self) -> None:
        self.alive: list[int] = []
        self.held: list[int] = []
        self.room: list[int] = []

    def _on_step(self) -> bool:
        assert isinstance(self.model, KNNTD)
        store = active_traces(self.model)
        entries, clock = store.arrays.active_entries, store.arrays.clock
        eligibility = entries[: store.count, :, : store.n_envs] * clock[0]
        self.alive.append(int((eligibility > 1e-18).any(axis=(1, 2)).sum()))
        self.held.append(store.count)
        self.room.append(store.capacity)
        return True


@pytest.mark.parametrize(
    ("n_envs", "length", "gamma", "trace_decay"),
    [(1, 20, 1.0, 1.0), (1, 10**9, 0.9, 0.9), (8, 20, 1.0, 1.0), (8, 20, 0.9, 0.9), (64, 10, 0.5, 0.2)],
)
def test_only_points_with_a_trace_are_kept(n_envs: int, length: int, gamma: float, trace_decay: float) -> None:
    watch = Alive()
    model = make_model(
        walks(n_envs, length=length, stride=0.2), points=(300, 300), gamma=gamma, trace_decay=trace_decay
    )
    model.learn(6_000 if n_envs < 64 else 12_800, callback=watch)
    # Many more points have been visited than have a trace at any time.
    assert model.policy.table.n_visited > 3 * max(watch.alive)
    if n_envs == 1:
        # The end of an episode clears all its traces, and a decayed trace is dropped before the third reset of the
        # decay product.
        assert max(watch.held) <= 2 * max(watch.alive)
    # If the capacity is used up, inactive points are removed, and the capacity becomes twice the number of active ones.
    per_step = 4 * n_envs
    assert max(watch.room) <= max(1024, 4 * max(watch.alive) + 4 * per_step)
    half = len(watch.room) // 2
    assert watch.room[half] == watch.room[-1]


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("dtype", [th.float64, th.float32])
@pytest.mark.parametrize("table", ["dense", "hashed"])
def test_reading_does_not_change_the_table(n_envs: int, dtype: th.dtype, table: str) -> None:
    def reader(local: dict[str, Any], _: dict[str, Any]) -> bool:
        policy = local["self"].policy
        policy.q_table.sum()
        policy.predict(local["new_obs"])
        return True

    arguments: dict[str, Any] = {"gamma": 1.0, "trace_decay": 0.97, "learning_rate": 0.02}
    read, unread = (
        make_model(walks(n_envs, length=150), table, dtype, **arguments).learn(600 * n_envs, callback=callback)
        for callback in (reader, None)
    )
    assert th.equal(read.policy.q_table, unread.policy.q_table)


class Tables(BaseCallback):
    """The table at some steps, read in every possible way."""

    def __init__(self, at: list[int]) -> None:
        super().__init__()
        self.at = at
        self.seen: list[np.ndarray] = []

    def _on_step(self) -> bool:
        assert isinstance(self.model, KNNTD)
        if self.n_calls in self.at:
            parameters = self.model.get_parameters()["policy"]
            shown = self.model.policy.q_table.clone()
            if isinstance(self.model.policy.table, DenseTable):
                assert th.equal(parameters["table.values"], shown)
            self.seen.append(as_dense(self.model))
        return True


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("table", ["dense", "hashed"])
def test_the_table_in_the_middle_of_an_episode(n_envs: int, table: str) -> None:
    at = [1, 2, 17, 100, 101, 299]
    arguments: dict[str, Any] = {"gamma": 1.0, "trace_decay": 0.97, "learning_rate": 0.02}
    compiled, torch = Tables(at), Tables(at)
    make_model(walks(n_envs, length=150), table, **arguments).learn(300 * n_envs, callback=compiled)
    make_model(walks(n_envs, length=150), "dense", compiled=False, **arguments).learn(300 * n_envs, callback=torch)
    assert len(compiled.seen) == len(at)
    for got, expected in zip(compiled.seen, torch.seen, strict=True):
        assert expected.any()
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("table", ["dense", "hashed"])
def test_parameters_in_the_middle_of_an_episode(n_envs: int, table: str) -> None:
    # Get the parameters, learn on, set them again: the old traces continue with the old table.
    arguments: dict[str, Any] = {"gamma": 1.0, "trace_decay": 0.97, "learning_rate": 0.02, "table": table}
    venv = walks(n_envs, length=150)
    model = make_model(venv, **arguments).learn(77 * n_envs)
    parameters, then = copy.deepcopy(model.get_parameters()), as_dense(model)
    place, stream = copy.deepcopy(venv), model._stream.state()
    seen = copy.deepcopy(model._last_obs)
    model.learn(60 * n_envs, reset_num_timesteps=False)
    uninterrupted = as_dense(model)

    model.set_parameters(parameters)
    np.testing.assert_array_equal(as_dense(model), then)
    assert not np.array_equal(then, uninterrupted)
    model.set_env(place, force_reset=False)
    model._stream.set_state(stream)
    model._last_obs, model.num_timesteps = seen, 77 * n_envs
    model.learn(60 * n_envs, reset_num_timesteps=False)
    np.testing.assert_array_equal(as_dense(model), uninterrupted)


class Replace(BaseCallback):
    """Sets other parameters of the model at one step, in the middle of an episode."""

    def __init__(self, at: int, parameters: Any) -> None:
        super().__init__()
        self.at, self.parameters = at, parameters

    def _on_step(self) -> bool:
        assert isinstance(self.model, KNNTD)
        if self.n_calls == self.at:
            self.model.set_parameters(self.parameters, exact_match=False)
            self.after = as_dense(self.model)
        return True


@pytest.mark.parametrize("table", ["dense", "hashed"])
def test_another_table_in_the_middle_of_learning(table: str) -> None:
    # The learner must release its arrays: later updates go to the new table.
    other = make_model(walks(seed=9), table, initial_value=50.0).learn(200)
    given = {"policy": copy.deepcopy(other.get_parameters()["policy"])}
    model = make_model(walks(length=1_000), table, initial_value=50.0)
    replace = Replace(70, given)
    model.learn(71, callback=replace)
    np.testing.assert_array_equal(replace.after, as_dense(other))
    # One more step has changed the four points of one state, and no others.
    changed = (as_dense(model) != replace.after).any(axis=1)
    assert changed.sum() == 4


# -------------------------------------------------------------------------------------------- memory


@pytest.mark.parametrize("n_actions", [2, 3, 6])
@pytest.mark.parametrize("dtype", [th.float64, th.float32])
def test_memory_of_a_dense_table_and_its_traces(dtype: th.dtype, n_actions: int) -> None:
    model = make_model(walks(n_actions=n_actions), dtype=dtype, points=(1000, 1000)).learn(3_000)
    assert isinstance(model.policy.table, DenseTable)
    assert model.policy.q_table.dtype == dtype
    # Four bytes a point count its visits.
    assert sizes(model) <= 1.1 * 10**6 * (n_actions * dtype.itemsize + 4)


def test_sizes_are_complete() -> None:
    # `sizes` lists everything that uses memory: nothing else in the model may grow with the points.
    model = make_model(walks(), points=(1000, 1000)).learn(1_000)
    known = sizes(model)
    found: dict[int, int] = {}

    def look(value: Any, depth: int) -> None:
        if isinstance(value, th.Tensor):
            value = value.detach().cpu().numpy()
        if isinstance(value, np.ndarray):
            found[value.__array_interface__["data"][0]] = value.nbytes
        elif depth:
            inside = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
            for part in [*inside, *vars(value).values()] if hasattr(value, "__dict__") else inside:
                look(part, depth - 1)

    look([model.policy, model.learner], 6)
    assert known <= sum(found.values()) <= known + 100_000


def test_single_precision_is_close() -> None:
    arguments: dict[str, Any] = {"gamma": 0.97, "trace_decay": 0.9, "target": "q_learning"}
    # The same steps for both: with ε = 1 rounding of the values does not affect the actions.
    arguments |= {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0}
    for table in ("dense", "hashed"):
        single, double = (
            make_model(walks(), table, dtype, **arguments).learn(3_000) for dtype in (th.float32, th.float64)
        )
        assert single.policy.q_table.dtype == th.float32
        assert double.policy.q_table.dtype == th.float64
        assert np.abs(as_dense(double)).max() > 1.0
        np.testing.assert_allclose(as_dense(single), as_dense(double), rtol=1e-4, atol=1e-4)


# ------------------------------------------------------------------------------------------- the kernels


def dispatchers() -> Iterator[tuple[str, Any]]:
    for module in (td, traces, selection, nearest, perceive):
        for name, value in vars(module).items():
            if hasattr(value, "py_func") and value.py_func.__module__ == module.__name__:
                yield name, value
    for number, kind in enumerate(state._KINDS):
        yield f"learn_at {number}", td._learn_at(kind)


def test_kernels_are_cached_and_release_the_gil() -> None:
    # The kernel of a step is made for each type of state.
    make_model(walks(), points=(4, 4)).learn(1)
    kernels = dict(dispatchers())
    assert {"learn_at 0", "begin", "recommend", "write_back", "flush", "nearest_on_lattice"} <= set(kernels)
    for name, kernel in kernels.items():
        assert kernel.targetoptions.get("nogil"), name
        assert type(kernel._cache).__name__ == "KernelCache", name


def test_other_threads_run_while_a_kernel_does(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(walks(), points=(200, 200), n_neighbors=9)
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (40_000, 2)).astype(np.float32)
    # What the kernel is called with, for it alone is looked at: NumPy lets go of the lock now and then, too.
    kernel, calls = td.recommend, []

    def keep(*arguments: Any) -> None:
        calls.append(arguments)
        kernel(*arguments)

    monkeypatch.setattr(td, "recommend", keep)
    model.predict(observations, deterministic=True)
    assert len(calls) == 1
    begun, done, ticks = threading.Event(), threading.Event(), []

    def tick() -> None:
        begun.wait()
        while not done.is_set():
            ticks.append(None)
            time.sleep(1e-4)

    other = threading.Thread(target=tick)
    interval = sys.getswitchinterval()
    try:
        # No forced thread switches: the other thread gets the GIL only if this one releases it.
        sys.setswitchinterval(1e3)
        other.start()
        begun.set()
        before = len(ticks)
        kernel(*calls[0])
        after = len(ticks)
    finally:
        sys.setswitchinterval(interval)
        done.set()
        begun.set()
        other.join()
    assert after > before


# Everything that may happen during training: growth of table and traces, both kinds of episode ends, reading, files,
# a second model. After the first step there must be nothing left to compile.
IN_A_NEW_PROCESS = """
import io, json, sys
from test_scale import dispatchers, make_model, walks
from stable_baselines3.common.callbacks import BaseCallback

def state():
    return {name: [len(d.signatures), sum(d.stats.cache_misses.values())] for name, d in dispatchers()}

class Watch(BaseCallback):
    def _on_step(self):
        self.model.policy.q_table
        if self.n_calls == 1:
            self.first = state()
        if self.n_calls == 600:
            self.model.save(io.BytesIO())
        return True

first_of, last_of = {}, {}
for name, n_envs, table, search in [
    ("one", 1, "dense", "lattice"), ("many", 8, "hashed", "lattice"), ("tree", 1, "dense", "kd_tree")
]:
    watch = Watch()
    env = walks(n_envs, stride=0.2, end="truncated" if n_envs == 1 else "terminated")
    arguments = dict(points=(200, 200), gamma=1.0, trace_decay=1.0, learning_rate=0.01, search=search)
    model = make_model(env, table, **arguments).learn(2_000 * n_envs, callback=watch)
    first_of[name], last_of[name] = watch.first, state()
    before = state()
    model.learn(100 * n_envs)
    assert state() == before, "a second learn compiled something"
hits = {name: sum(d.stats.cache_hits.values()) for name, d in dispatchers()}
print(json.dumps({"first": first_of, "last": last_of, "hits": hits}))
"""


def in_a_new_process(**environment: str) -> dict[str, Any]:
    """The report of a process about its compilation."""
    run = subprocess.run(
        [sys.executable, "-c", IN_A_NEW_PROCESS],
        cwd=pathlib.Path(__file__).parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    report: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
    return report


def test_kernels_are_compiled_once_for_all_processes() -> None:
    # If the kernels were never used before, the first process compiles them.
    report = in_a_new_process()
    if any(misses for _, misses in report["last"]["tree"].values()):
        report = in_a_new_process()
    assert all(misses == 0 for state in report["last"].values() for _, misses in state.values())
    for kernel in ("learn_at 0", "begin"):
        assert report["hits"][kernel] > 0


@pytest.mark.slow
def test_nothing_is_compiled_after_the_first_step(tmp_path: pathlib.Path) -> None:
    # With an empty cache, so that everything compiled after the first step is detected.
    report = in_a_new_process(NUMBA_CACHE_DIR=str(tmp_path))
    assert report["first"]["one"]["learn"] == [1, 1]
    for run, first in report["first"].items():
        later = {name: (before, report["last"][run][name]) for name, before in first.items()}
        assert not {name: change for name, change in later.items() if change[0] != change[1]}, run


def test_a_second_learn_compiles_nothing() -> None:
    model = make_model(walks()).learn(100)
    before = {name: len(kernel.signatures) for name, kernel in dispatchers()}
    model.learn(100)
    make_model(walks(), points=(30, 10), n_neighbors=7, target="q_learning", trace_decay=0.5).learn(100)
    assert {name: len(kernel.signatures) for name, kernel in dispatchers()} == before


# -------------------------------------------------------------------------------------- many environments


@pytest.mark.slow
def test_sixty_four_environments_learn_as_stably_as_one() -> None:
    final: dict[int, list[float]] = {1: [], 64: []}
    for n_envs, returns in final.items():
        for seed in range(10):
            model = KNNTD(make_vec_env("MountainCar-v0", n_envs, seed=seed), seed=seed).learn(200_000)
            evaluation = make_vec_env("MountainCar-v0", 10, seed=10_000 + seed)
            mean, _ = evaluate_policy(model, evaluation, n_eval_episodes=100, deterministic=True)
            assert isinstance(mean, float)
            returns.append(mean)
    one, many = np.median(final[1]), np.median(final[64])
    assert many >= one - 0.05 * abs(one)


@pytest.mark.slow
@pytest.mark.skipif(not pathlib.Path("/proc/self/statm").exists(), reason="reads the memory from /proc")
def test_memory_is_flat_over_ten_million_steps() -> None:
    def resident() -> int:
        return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    # Without a Monitor, which keeps the returns of all episodes.
    model = KNNTD(DummyVecEnv([lambda: gym.make("MountainCar-v0")]), points=20, seed=0)
    model.learn(100_000)
    before = resident()
    model.learn(10**7, reset_num_timesteps=False, log_interval=None)
    assert resident() - before < 2**21
