"""`points="grow"`: visited observations become points, and what was learned stays."""

from __future__ import annotations

import itertools
import pathlib
import signal
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from test_robustness import read_in_threads
from toy_envs import DriftEnv, GridEnv, PushEnv, RecordingVecEnv, StillEnv

from sb3_knntd import KNNTD, ExA
from sb3_knntd.learners import Transitions
from sb3_knntd.q_table import GrowingTable

Algorithm = type[KNNTD] | type[ExA]
ALGORITHMS: list[Algorithm] = [KNNTD, ExA]
LEARNERS: dict[str, dict[str, Any]] = {"compiled": {}, "torch": {"compiled": False}}
UNKNOWN = spaces.Box(-np.inf, np.inf, (2,), dtype=np.float32)


class Unbounded(gym.ObservationWrapper[Any, Any, Any]):
    """An environment that declares no bounds of its observations."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = UNKNOWN

    def observation(self, observation: Any) -> Any:
        return observation


def make_venv(algorithm: Algorithm = KNNTD, n_envs: int = 1, known: bool = True) -> VecEnv:
    def make(index: int) -> gym.Env[Any, Any]:
        env = (PushEnv if algorithm is ExA else DriftEnv)(offset=0.23 * index, lengths=(9, 14, 60))
        return Monitor(env if known else Unbounded(env))

    return DummyVecEnv([lambda index=index: make(index) for index in range(n_envs)])  # type: ignore[misc]


def make_model(algorithm: Algorithm = KNNTD, n_envs: int = 1, known: bool = True, **arguments: Any) -> Any:
    given = {
        "points": "grow",
        "spacing": 0.1,
        "bounds": (DriftEnv.LOW, DriftEnv.HIGH) if known else None,
        "n_neighbors": 4,
        "learning_rate": 0.2,
        "seed": 0,
        **arguments,
    }
    return algorithm(make_venv(algorithm, n_envs, known), **given)


def distances(policy: Any, observations: np.ndarray) -> np.ndarray:
    """Distances of observations from all points, scaled units, shape (batch, n_points)."""
    bounds = policy.perceiver.bounds
    scaled, points = (bounds.scale(th.as_tensor(each, dtype=th.float64)) for each in (observations, policy.points))
    array: np.ndarray = (scaled[:, None] - points).square().sum(dim=2).sqrt().numpy()
    return array


def least_distance(policy: Any) -> float:
    between = distances(policy, policy.points)
    return float(between[~np.eye(len(between), dtype=bool)].min(initial=np.inf))


def keep_up(policy: Any, observations: np.ndarray) -> None:
    """What an algorithm does at each step."""
    if not policy.perceiver.sees(observations):
        policy.lay_anew(observations)
    policy.grow(observations)


# -------------------------------------------------------------- which points


@settings(max_examples=60, deadline=None)
@given(
    n_dims=st.integers(1, 4),
    known=st.booleans(),
    spacing=st.floats(0.05, 1.5),
    max_points=st.integers(5, 60),
    walk=st.booleans(),
    seed=st.integers(0, 2**16),
)
def test_points_are_as_far_apart_as_the_spacing_and_near_what_is_visited(
    n_dims: int, known: bool, spacing: float, max_points: int, walk: bool, seed: int
) -> None:
    model = KNNTD(
        StillEnv(n_dims),
        points="grow",
        spacing=spacing,
        max_points=max_points,
        n_neighbors=3,
        bounds=(-np.ones(n_dims), np.ones(n_dims)) if known else "adaptive",
    )
    random, policy, was_full = np.random.default_rng(seed), model.policy, False
    visited = random.normal(0.0, 0.5, (120, n_dims)) * np.logspace(0, 2, n_dims)
    visited = visited.cumsum(axis=0) if walk else visited
    for observation in visited:
        keep_up(policy, observation[None])
        points = policy.perceiver.points
        was_full |= points.is_full
        assert points.n_points <= max_points
        assert least_distance(policy) > float(points.spacing)
        # It lies within the spacing of a point when its step is over, however many points there may be.
        assert distances(policy, observation[None]).min() <= float(points.spacing)
    assert {tuple(point) for point in policy.points.numpy()} <= {tuple(observation) for observation in visited}
    assert len(policy.q_table) == len(policy.points)
    assert float(points.spacing) == spacing or was_full


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("kwargs", LEARNERS.values(), ids=LEARNERS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_all_that_is_perceived_lies_near_a_point(algorithm: Algorithm, kwargs: dict[str, Any], n_envs: int) -> None:
    """Also the last observations before a truncation, and the first ones of an episode."""
    venv = RecordingVecEnv(make_venv(algorithm, n_envs))
    arguments: dict[str, Any] = {"points": "grow", "spacing": 0.1, "bounds": (DriftEnv.LOW, DriftEnv.HIGH)}
    model: Any = algorithm(venv, seed=0, policy_kwargs=kwargs, **arguments).learn(150 * n_envs)
    seen = [step.observations for step in venv.steps] + [step.arrived[step.truncated] for step in venv.steps]
    assert distances(model.policy, np.concatenate(seen)).min(axis=1).max() <= 0.1
    assert least_distance(model.policy) > 0.1
    # A terminal state has no value to read.
    ends = np.concatenate([step.arrived[step.terminated] for step in venv.steps])
    assert not {tuple(end) for end in ends.tolist()} & {tuple(point) for point in model.policy.points.tolist()}


def test_the_default_spacing_grows_with_the_dimensions() -> None:
    for n_dims, spacing in ((1, 0.04), (2, 0.06), (3, 0.12), (6, 0.3)):
        model = KNNTD(StillEnv(n_dims), points="grow")
        assert float(model.policy.perceiver.points.spacing) == pytest.approx(spacing)  # type: ignore[arg-type]


def test_when_there_are_too_many_points_every_second_one_stays() -> None:
    """The spacing grows by 2^(1/D), and what was learned at the dropped points goes to those that stay."""
    model = KNNTD(StillEnv(1), points="grow", spacing=0.1, max_points=8, bounds=([-1.0], [1.0]), n_neighbors=1)
    policy = model.policy
    policy.grow(np.arange(8)[:, None] * 0.125)
    assert policy.perceiver.points.is_full
    policy.q_table.copy_(th.arange(8.0)[:, None].expand(8, 3))
    policy.table.visit(th.tensor([0, 1, 2, 3, 5]))  # type: ignore[operator]
    moved = policy.lay_anew(np.array([[0.0]]))
    np.testing.assert_array_equal(moved, [0, 0, 1, 1, 2, 2, 3, 3])
    np.testing.assert_allclose(policy.points.numpy()[:, 0], [0.0, 0.25, 0.5, 0.75])
    assert float(policy.perceiver.points.spacing) == 0.2  # type: ignore[arg-type]
    # The mean of the visited ones; of all where none was visited.
    assert policy.q_table[:, 0].tolist() == [0.5, 2.5, 5.0, 6.5]
    assert policy.table.n_visited == 3
    assert policy.grow(np.array([[0.4], [0.96]])).tolist() == [4]


# ----------------------------------------------------- the scale that follows


def test_an_unknown_range_is_the_one_that_was_visited() -> None:
    """From the first step on, without random steps at the start; a known range stays."""
    ranges = []

    def look(local: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append(local["new_obs"].copy())
        bounds = model.policy.perceiver.bounds
        ranges.append((bounds.low.numpy().copy(), bounds.high.numpy().copy()))
        return True

    model = KNNTD("CartPole-v1", points="grow", seed=0)
    seen = [model.get_env().reset()]  # type: ignore[union-attr]
    model.learn(2000, callback=look)
    for step, (low, high) in enumerate(ranges[20:], 22):
        least, most = np.concatenate(seen[:step]).min(axis=0), np.concatenate(seen[:step]).max(axis=0)
        for dimension in (1, 3):
            width = high[dimension] - low[dimension]
            assert least[dimension] - 0.11 * width <= low[dimension] <= least[dimension] + 0.11 * width
            assert most[dimension] - 0.11 * width <= high[dimension] <= most[dimension] + 0.11 * width
    space = model.observation_space
    assert isinstance(space, spaces.Box)
    np.testing.assert_array_equal(low[[0, 2]], space.low[[0, 2]])
    np.testing.assert_array_equal(high[[0, 2]], space.high[[0, 2]])


def test_a_dimension_that_never_changes_tells_no_states_apart() -> None:
    model = KNNTD(StillEnv(2), points="grow", bounds="adaptive", n_neighbors=1)
    for x in np.linspace(0.0, 1.0, 30):
        keep_up(model.policy, np.array([[x, 0.7 * (1.0 + 1e-9 * x)]]))
    assert least_distance(model.policy) > 0.06
    assert distances(model.policy, np.array([[0.5, 0.7]])).min() <= 0.06


def test_points_that_come_too_near_are_merged_when_the_range_grows() -> None:
    model = KNNTD(StillEnv(1), points="grow", spacing=0.5, bounds="adaptive", n_neighbors=1)
    policy = model.policy
    for x in (0.0, 1.0, 0.5):
        keep_up(policy, np.array([[x]]))
    assert policy.points[:, 0].tolist() == [0.0, 1.0, 0.5]
    policy.q_table.copy_(th.tensor([[1.0], [2.0], [4.0]]).expand(3, 3))
    # A tenth more is tolerated.
    assert policy.perceiver.sees(np.array([[1.09], [-0.09]]))
    np.testing.assert_array_equal(policy.lay_anew(np.array([[8.0]])), [0, 0, 0])
    assert policy.points[:, 0].tolist() == [0.0]
    assert policy.q_table[0, 0] == pytest.approx(7 / 3)
    # Nothing is dropped, and nothing changes, if all points are still far apart.
    policy.grow(np.array([[8.0], [4.0]]))
    values = policy.q_table.clone()
    assert policy.lay_anew(np.array([[9.0]])) is None
    assert th.equal(policy.q_table, values)


def test_normalised_observations_are_followed() -> None:
    venv = VecNormalize(make_venv(n_envs=2, known=False))
    model = KNNTD(venv, points="grow", seed=0).learn(600)
    assert model.policy.perceiver.sees(np.asarray(venv.normalize_obs(venv.get_original_obs())))
    assert len(model.policy.points) > 20


# ------------------------------------------------------------ what is learned


@pytest.mark.parametrize("initial_value", [0.0, -30.0, 5.0])
def test_a_new_point_is_worth_what_was_read_there_or_the_initial_value(initial_value: float) -> None:
    model = make_model(initial_value=initial_value).learn(300)
    policy = model.policy
    new = np.array([[2.0, 0.05], [-0.95, 0.2]])
    for observation in new:
        read = policy.q_values(observation)
        (index,) = policy.grow(observation[None])
        assert th.equal(policy.q_table[index], read[0].clamp(min=initial_value))


@pytest.mark.parametrize("kwargs", LEARNERS.values(), ids=LEARNERS)
def test_other_points_keep_their_values_and_traces(kwargs: dict[str, Any]) -> None:
    model = make_model(policy_kwargs=kwargs, trace_decay=1.0, gamma=1.0).learn(40)
    policy = model.policy
    values, traces = policy.q_table.clone(), model.learner.state_dict()["traces"]
    n_before = len(values)
    # Enough of them for new arrays.
    random = np.random.default_rng(0)
    added = policy.grow(random.uniform(DriftEnv.LOW, DriftEnv.HIGH, (400, 2)))
    assert len(added) > 100
    assert th.equal(policy.q_table[:n_before], values)
    model.learner.load_state_dict(model.learner.state_dict())
    after = model.learner.state_dict()["traces"]
    assert len(traces["points"]) > 5
    for name in ("points", "traces", "base", "share"):
        assert th.equal(after[name], traces[name]), name


@pytest.mark.parametrize("kwargs", [*LEARNERS.values(), {"dtype": th.float32}], ids=[*LEARNERS, "float32"])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_growing_table_equals_one_that_had_the_points_from_the_start(
    kwargs: dict[str, Any], traces: str, n_envs: int
) -> None:
    """
    By construction: each state is a cell and its own point, the only neighbour of itself, and all rewards are negative,
    so that new points begin with the initial value.
    """

    def make(points: Any) -> KNNTD:
        venv = DummyVecEnv([lambda index=index: Grid(index) for index in range(n_envs)])  # type: ignore[misc]
        return KNNTD(venv, points=points, n_neighbors=1, traces=traces, seed=0, learning_rate=0.3, policy_kwargs=kwargs)

    class Grid(GridEnv):
        def __init__(self, index: int) -> None:
            super().__init__("box", lengths=(20 + index, 45), ends=("truncated", "terminated"))

    growing = make("grow").learn(400)
    points = growing.policy.points.numpy()
    assert 20 < len(points) <= 45
    whole = make(points).learn(400)
    assert th.equal(growing.policy.q_table, whole.policy.q_table)
    assert growing.policy.table.n_visited == whole.policy.table.n_visited
    assert growing.learner.n_traced == whole.learner.n_traced


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_once_grown_it_learns_like_one_with_these_points(algorithm: Algorithm) -> None:
    grown = make_model(algorithm).learn(2000)
    points = grown.policy.points.numpy()
    fixed = make_model(algorithm, points=points, spacing="auto")
    again = make_model(algorithm)
    # From here on nothing is far enough to become a point.
    state = {"table.values": th.zeros_like(grown.policy.q_table), "perceiver.points.spacing": th.tensor(1e3).double()}
    again.policy.load_state_dict({**grown.policy.state_dict(), **state})
    for model in (fixed, again):
        model.learn(300)
    assert len(again.policy.points) == len(points)
    assert th.equal(again.policy.q_table, fixed.policy.q_table)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize(
    "arguments",
    [{}, {"known": False}, {"max_points": 30, "trace_decay": 0.5}, {"weights": "gaussian", "bandwidth": 0.1}],
    ids=["known", "unknown", "few", "gaussian"],
)
def test_compiled_and_torch_learn_the_same(algorithm: Algorithm, n_envs: int, arguments: dict[str, Any]) -> None:
    one, other = (
        make_model(algorithm, n_envs, policy_kwargs=kwargs, tie_break="first", **arguments).learn(300)
        for kwargs in LEARNERS.values()
    )
    # ExA's actions, and so the observations, may differ in the last digit.
    th.testing.assert_close(one.policy.points, other.policy.points, rtol=1e-6, atol=1e-6)
    th.testing.assert_close(one.policy.q_table, other.policy.q_table, rtol=1e-7, atol=1e-7)
    assert one.policy.table.n_visited == other.policy.table.n_visited
    assert one.policy.perceiver.points.spacing == other.policy.perceiver.points.spacing


def test_a_function_as_weights_sees_only_points() -> None:
    """With fewer points than neighbours no distance is infinite."""

    def weigh(squared_distances: th.Tensor) -> th.Tensor:
        assert th.isfinite(squared_distances).all()
        return 1.0 / (1.0 + squared_distances)

    one, other = (make_model(weights=weights, n_neighbors=9).learn(200) for weights in (weigh, "inverse_quadratic"))
    th.testing.assert_close(one.policy.q_table, other.policy.q_table, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kwargs", LEARNERS.values(), ids=LEARNERS)
def test_given_transitions_are_grown_over(kwargs: dict[str, Any]) -> None:
    venv = RecordingVecEnv(make_venv(known=False))
    KNNTD(venv, points=9, bounds=(DriftEnv.LOW, DriftEnv.HIGH), seed=0).learn(300)
    steps = venv.steps
    columns = [np.concatenate([getattr(step, name) for step in steps]) for name in (
        "observations", "actions", "rewards", "arrived", "terminated", "truncated"
    )]  # fmt: skip
    transitions = Transitions(*columns[:5], columns[4] | columns[5])
    model = make_model(known=False, policy_kwargs=kwargs, max_points=40)
    model.learner.update(transitions, 0.3, 0.9)
    assert 10 < len(model.policy.points) < 40
    assert model.policy.perceiver.sees(transitions.observations)
    assert model.policy.table.n_visited > 10
    model.learn(200)
    assert th.isfinite(model.policy.q_table).all()


# ------------------------------------------------------------------- saving


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("kwargs", LEARNERS.values(), ids=LEARNERS)
@pytest.mark.parametrize("steps", [5, 200])
@pytest.mark.parametrize("known", [True, False])
def test_interrupted_run_equals_the_uninterrupted(
    tmp_path: pathlib.Path, algorithm: Algorithm, kwargs: dict[str, Any], steps: int, known: bool
) -> None:
    arguments: dict[str, Any] = {"known": known, "max_points": 60, "policy_kwargs": kwargs}
    whole = make_model(algorithm, **arguments).learn(steps).learn(200, reset_num_timesteps=False)
    broken = make_model(algorithm, **arguments).learn(steps)
    broken.save(tmp_path / "model")
    resumed: Any = algorithm.load(tmp_path / "model", env=broken.get_env(), force_reset=False)
    assert th.equal(resumed.policy.points, broken.policy.points)
    resumed.learn(200, reset_num_timesteps=False)
    assert not th.equal(whole.policy.points, broken.policy.points)
    assert th.equal(resumed.policy.points, whole.policy.points)
    assert th.equal(resumed.policy.q_table, whole.policy.q_table)
    assert resumed.policy.table.n_visited == whole.policy.table.n_visited
    assert resumed.learner.n_traced == whole.learner.n_traced


def test_a_model_without_points_predicts_and_is_saved(tmp_path: pathlib.Path) -> None:
    model = make_model(initial_value=3.0)
    assert model.policy.points.shape == (0, 2)
    assert model.policy.q_table.shape == (0, 3)
    observation = np.zeros(2, np.float32)
    assert model.policy.q_values(observation).tolist() == [[3.0, 3.0, 3.0]]
    assert model.predict(observation, deterministic=True)[0] == 0
    model.save(tmp_path / "model")
    loaded = KNNTD.load(tmp_path / "model", env=make_venv()).learn(100)
    assert th.equal(loaded.policy.q_table, model.learn(100).policy.q_table)


def test_policies_and_vectors_are_saved_and_loaded(tmp_path: pathlib.Path) -> None:
    policy = make_model(known=False).learn(300).policy
    policy.save(tmp_path / "policy")
    loaded = type(policy).load(tmp_path / "policy")
    observations = np.random.default_rng(0).uniform(DriftEnv.LOW, DriftEnv.HIGH, (50, 2)).astype(np.float32)
    assert th.equal(loaded.q_values(observations), policy.q_values(observations))
    vector = policy.parameters_to_vector()
    policy.load_from_vector(2.0 * vector)
    np.testing.assert_array_equal(policy.parameters_to_vector(), 2.0 * vector)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("table.values", lambda value: value[:-1]),
        ("table.values", lambda value: value * np.nan),
        ("table.visits", lambda value: value[:-1]),
        ("perceiver.points.places", lambda value: value[:, :1]),
        ("perceiver.points.spacing", lambda value: value * 0.0),
        ("perceiver.points.spacing", lambda value: value * np.inf),
    ],
)
def test_damaged_states_are_refused(name: str, change: Callable[[th.Tensor], th.Tensor]) -> None:
    policy = make_model().learn(100).policy
    state = policy.state_dict()
    with pytest.raises((ValueError, RuntimeError), match=name.rpartition(".")[2]):
        policy.load_state_dict({**state, name: change(state[name])})


# -------------------------------------------------------------- robustness


@pytest.mark.parametrize("method", ["add_rows", "merge_rows"])
def test_a_failure_leaves_points_and_table_as_they_were(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    model = make_model(known=False).learn(300)
    policy = model.policy
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    far = np.array([[30.0, 30.0]], dtype=np.float32)
    values = policy.q_values(far)

    def fail(*_: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(GrowingTable, method, fail)
    with pytest.raises(MemoryError):
        policy.grow(far) if method == "add_rows" else policy.lay_anew(far)
    for name, value in policy.state_dict().items():
        assert th.equal(value, before[name]), name
    assert th.equal(policy.q_values(far), values)
    monkeypatch.undo()
    model.learn(100)
    assert len(policy.points) == len(policy.q_table)


@pytest.mark.parametrize("known", [True, False])
def test_an_interrupt_while_a_point_comes_waits_until_it_is_there(monkeypatch: pytest.MonkeyPatch, known: bool) -> None:
    model, real, count = make_model(known=known), GrowingTable.add_rows, itertools.count()

    def add_rows(table: GrowingTable, values: th.Tensor) -> None:
        if next(count) == 30:
            signal.raise_signal(signal.SIGINT)
        real(table, values)

    monkeypatch.setattr(GrowingTable, "add_rows", add_rows)
    with pytest.raises(KeyboardInterrupt):
        model.learn(300)
    assert len(model.policy.points) == len(model.policy.q_table)
    assert least_distance(model.policy) > 0.1
    model.learn(100)
    assert th.isfinite(model.policy.q_table).all()


@pytest.mark.parametrize("kwargs", LEARNERS.values(), ids=LEARNERS)
def test_reading_in_other_threads_changes_nothing(kwargs: dict[str, Any]) -> None:
    alone, read = (make_model(known=False, max_points=80, policy_kwargs=kwargs) for _ in range(2))
    alone.learn(700)
    assert read_in_threads(read, 700, 200) >= 200
    assert th.equal(alone.policy.points, read.policy.points)
    assert th.equal(alone.policy.q_table, read.policy.q_table)


def test_a_step_that_fails_leaves_the_values_as_they_were() -> None:
    model = make_model(learning_rate=1e200)
    with pytest.raises(FloatingPointError, match="The table is as it was"):
        model.learn(100)
    assert not model.policy.q_table.any()


# ------------------------------------------------------------- how it is used


def test_the_number_of_points_is_logged() -> None:
    for points, logged in (("grow", True), (6, False)):
        model = make_model(points=points)
        model.learn(100, log_interval=None)
        assert ("train/n_points" in model._log()) is logged
    assert make_model().learn(100)._log()["train/n_points"] > 10


def test_what_does_not_go_with_points_that_grow_is_named() -> None:
    with pytest.raises(ValueError, match=r"search must be 'auto' or 'brute' for points that grow.*'kd_tree'"):
        make_model(search="kd_tree")
    with pytest.raises(ValueError, match=r"table of points that grow must be .*'dense'.*'hashed'"):
        make_model(policy_kwargs={"table": "hashed"})
    with pytest.raises(ValueError, match=r"n_neighbors must be at most the number of points, 3; got 4"):
        make_model(max_points=3)
    with pytest.raises(ValueError, match=r"points must be 'auto' for a Discrete observation space.*'grow'"):
        KNNTD("FrozenLake-v1", points="grow")
    with pytest.raises(ValueError, match=r"points must be 'auto', 'grow', an int"):
        make_model(points="growing")
    with pytest.raises(AttributeError, match="spacing cannot be changed"):
        make_model().spacing = 0.2


def test_a_range_that_grows_does_not_stop_learning() -> None:
    """Traces end where points are dropped, and episodes go on."""
    model = make_model(known=False)
    dropped: list[bool] = []

    def look(local: dict[str, Any], _: dict[str, Any]) -> bool:
        dropped.append(not model.learner.in_episodes)
        return True

    model.learn(1500, callback=look)
    # More and more seldom: each time, a range has grown by a tenth.
    assert sum(dropped[:500]) > sum(dropped[500:1000]) + sum(dropped[1000:])
    assert any(before and not after for before, after in itertools.pairwise(dropped))
    assert model.policy.table.n_visited > 20
