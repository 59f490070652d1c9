"""Ex⟨a⟩(λ): the table against `examples/exa_from_scratch.py`, and features that only ExA has."""

from __future__ import annotations

import io
import itertools
import math
import pathlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from exa_from_scratch import Choice, ExAAgent, Transition
from hypothesis import given, settings
from hypothesis import strategies as st
from knn_td_from_scratch import NearestPoints, Rates
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import DriftEnv, PushEnv, RecordingVecEnv

import sb3_knntd.envs  # noqa: F401  registers the paper's environments
from sb3_knntd import KNNTD, ExA

# Both learners, as policy_kwargs.
LEARNERS: dict[str, dict[str, Any]] = {"torch": {"compiled": False}, "compiled": {}}
BOUNDS = (DriftEnv.LOW, DriftEnv.HIGH)
SCATTERED = np.random.default_rng(5).uniform(
    DriftEnv.LOW - 0.05 * (DriftEnv.HIGH - DriftEnv.LOW), DriftEnv.HIGH, size=(40, 2)
)
POINTS: dict[str, Any] = {"lattice": (8, 6), "scattered": SCATTERED}
# No point is the mean of two others, so that a mean is distinguishable from a point.
ONE = [[-1.0, -0.13, 0.71, 0.9]]
TWO = [[-1.0, 0.37, 0.83], [0.11, 0.29]]


def make_venv(n_envs: int = 1, **arguments: Any) -> DummyVecEnv:
    """Pushed points with episodes of 9, 14, 6, 9, ... steps."""
    return DummyVecEnv(
        [lambda n=index: Monitor(PushEnv(offset=0.3 * n, **arguments)) for index in range(n_envs)]  # type: ignore[misc]
    )


def make_model(env: Any = None, **arguments: Any) -> ExA:
    """A model with few default arguments, because defaults may change."""
    chosen: dict[str, Any] = {
        "learning_rate": 0.2,
        "gamma": 0.97,
        "trace_decay": 0.8,
        "n_neighbors": 4,
        "points": (8, 6),
        "bounds": BOUNDS,
        "step_size": "normalized",
        "action_points": 3,
        "exploration_initial_eps": 0.3,
        "exploration_final_eps": 0.3,
        "exploration_hold": 4.0,
        "seed": 0,
    }
    return ExA(make_venv() if env is None else env, **{**chosen, **arguments})


def table(model: ExA) -> np.ndarray:
    return model.policy.q_table.detach().cpu().numpy().copy()


def set_random_table(model: ExA, seed: int) -> None:
    with th.no_grad():
        # Few different values, to have ties.
        values = np.random.default_rng(seed).integers(0, 6, size=model.policy.q_table.shape)
        model.policy.q_table.copy_(th.as_tensor(values))


def message_of(make: Callable[[], Any]) -> str:
    with pytest.raises(ValueError, match=r"\w") as error:
        make()
    return str(error.value)


# ------------------------------------------------------------------------------------- against the reference


def explored(learner: ExAAgent, own: Choice, taken: np.ndarray) -> Choice:
    """
    The choice that gave an action with shared exploration: in each part the column of the action if it is an action
    point, otherwise the columns that the neighbours recommend.
    """
    columns = own.columns.copy()
    for number, part in enumerate(learner.parts):
        seen = taken[number : number + 1] if learner.factored else taken
        (exact,) = np.nonzero(np.abs(part - seen).max(axis=1) < 1e-12)
        if len(exact):
            columns[:, number] = exact[0]
    return Choice(own.neighbours, columns)


def replay(venv: RecordingVecEnv, learner: ExAAgent, rates: Rates, tolerance: float = 1e-9) -> tuple[ExAAgent, float]:
    """
    The reference after the recorded steps. Each recorded action must be exploratory, or the one that the reference
    selects with the table at the time of the observation.

    :return: the reference, and the share of exploratory choices
    """
    steps, n_explored, n_choices = venv.steps, 0, 0

    def choose(number: int) -> list[Choice]:
        nonlocal n_explored, n_choices
        choices = []
        for state, taken in zip(steps[number].observations, steps[number].actions, strict=True):
            own = learner.recommend(state)
            if rates.epsilon > 0.0:
                choice = explored(learner, own, taken.ravel())
                n_explored += not np.array_equal(choice.columns, own.columns)
            else:
                choice = own
            n_choices += 1
            np.testing.assert_allclose(taken.ravel(), learner.action(choice), rtol=tolerance, atol=tolerance)
            choices.append(choice)
        return choices

    choices = choose(0)
    for number, step in enumerate(steps):
        ahead = choose(number + 1) if number + 1 < len(steps) else choices
        together = [
            Transition(
                choices[env],
                float(step.rewards[env]),
                step.arrived[env],
                bool(step.terminated[env]),
                bool(step.truncated[env]),
            )
            for env in range(venv.num_envs)
        ]
        learner.learn(together, rates)
        choices = ahead
    return learner, n_explored / n_choices


def check(
    learner: str,
    n_steps: int,
    *,
    lists: Sequence[Sequence[float]] = ONE,
    n_envs: int = 1,
    epsilon: float = 0.0,
    action_table: str = "joint",
    env: dict[str, Any] | None = None,
    **arguments: Any,
) -> RecordingVecEnv:
    """Record, replay and compare; returns the record for further checks."""
    chosen = {
        "learning_rate": 0.2,
        "gamma": 0.97,
        "trace_decay": 0.8,
        "n_neighbors": 4,
        "points": "lattice",
        "step_size": "normalized",
        "traces": "replacing",
        "reset_other_actions": False,
        "initial_value": 0.0,
        **arguments,
    }
    chosen["points"] = POINTS[chosen["points"]]
    venv = RecordingVecEnv(make_venv(n_envs, shape=(len(lists),), **(env or {})))
    model = make_model(
        venv,
        action_points=[np.array(points) for points in lists],
        action_table=action_table,
        exploration_initial_eps=epsilon,
        exploration_final_eps=epsilon,
        tie_break="first",
        policy_kwargs=LEARNERS[learner],
        **chosen,
    )
    model.learn(n_steps * n_envs)
    assert len(venv.steps) == n_steps

    rates = Rates(chosen.pop("learning_rate"), chosen.pop("trace_decay"), epsilon)
    perceive = NearestPoints(chosen.pop("points"), BOUNDS, chosen.pop("n_neighbors"))
    reference = ExAAgent(perceive, lists, n_envs, factored=action_table == "factored", **chosen)
    reference, share = replay(venv, reference, rates)
    got, expected = table(model), reference.q_table
    # Equal tables prove nothing if nothing was learned or the values diverged.
    assert 1e-3 < np.abs(expected - chosen["initial_value"]).max() < 1e6
    assert got.shape == expected.shape
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)
    if epsilon > 0.0:
        assert share > 0.2 * epsilon, "too little was explored for a comparison"
    return venv


TRACES: dict[str, dict[str, Any]] = {
    "replacing, normalized": {},
    "replacing and clearing, paper": {"reset_other_actions": True, "step_size": "paper"},
    # With a larger step size long accumulating traces overshoot, and the result depends on rounding.
    "accumulating, paper": {"traces": "accumulating", "step_size": "paper", "learning_rate": 0.05},
}


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("points", POINTS)
@pytest.mark.parametrize("n_neighbors", [1, 4, 9])
@pytest.mark.parametrize("trace_decay", [0.0, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("form", TRACES.values(), ids=TRACES)
def test_same_table(learner: str, points: str, n_neighbors: int, trace_decay: float, form: dict[str, Any]) -> None:
    venv = check(learner, 70, points=points, n_neighbors=n_neighbors, trace_decay=trace_decay, **form)
    for what in ("terminated", "truncated"):
        assert sum(getattr(step, what).sum() for step in venv.steps) >= 2


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("action_table", ["joint", "factored"])
@pytest.mark.parametrize("form", TRACES.values(), ids=TRACES)
@pytest.mark.parametrize("epsilon", [0.0, 0.6])
def test_two_action_dimensions(
    learner: str, n_envs: int, action_table: str, form: dict[str, Any], epsilon: float
) -> None:
    check(learner, 90, lists=TWO, n_envs=n_envs, action_table=action_table, epsilon=epsilon, **form)


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("end", ["terminated", "truncated", "both", "never"])
def test_ends_of_episodes(learner: str, end: str) -> None:
    check(learner, 60, n_envs=2, trace_decay=0.95, env={"ends": (end,), "lengths": (7, 11)})


@pytest.mark.parametrize("learner", LEARNERS)
def test_one_environment_ends_early(learner: str) -> None:
    """One of three environments has very short episodes."""
    lengths = [(40,), (5, 3), (40,)]
    venv = RecordingVecEnv(
        DummyVecEnv([partial(PushEnv, offset=0.3 * n, lengths=each) for n, each in enumerate(lengths)])
    )
    model = make_model(
        venv, action_points=ONE, exploration_initial_eps=0.0, exploration_final_eps=0.0, trace_decay=0.95,
        tie_break="first", policy_kwargs=LEARNERS[learner],
    ).learn(3 * 39)  # fmt: skip
    assert sum(step.terminated[1] + step.truncated[1] for step in venv.steps) > 5
    assert not any(step.terminated[0] or step.terminated[2] for step in venv.steps)
    reference = ExAAgent(NearestPoints((8, 6), BOUNDS, 4), ONE, 3, gamma=0.97)
    reference, _ = replay(venv, reference, Rates(0.2, 0.95))
    np.testing.assert_allclose(table(model), reference.q_table, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("initial_value", [2.0, -20.0])
def test_initial_value(learner: str, initial_value: float) -> None:
    # With a small step size no value returns to its initial value; one environment gives a unique order of summation.
    check(learner, 60, initial_value=initial_value, trace_decay=0.5)


@pytest.mark.parametrize("action_table", ["joint", "factored"])
def test_a_table_of_the_visited_points_only(action_table: str) -> None:
    arguments: dict[str, Any] = {"action_points": TWO, "action_table": action_table, "tie_break": "first"}
    venvs = [make_venv(2, shape=(2,)) for _ in range(2)]
    dense, hashed = (
        make_model(venv, policy_kwargs={"table": kind}, **arguments).learn(200)
        for venv, kind in zip(venvs, ("dense", "hashed"), strict=True)
    )
    observations = np.random.default_rng(0).uniform(*BOUNDS, size=(100, 2)).astype(np.float32)
    np.testing.assert_allclose(
        dense.policy.q_values(observations), hashed.policy.q_values(observations), rtol=1e-9, atol=1e-9
    )
    actions = [model.predict(observations, deterministic=True)[0] for model in (dense, hashed)]
    np.testing.assert_allclose(*actions)


@pytest.mark.parametrize("exploration", ["shared", "per_neighbor"])
@pytest.mark.parametrize("tie_break", ["first", "random"])
@pytest.mark.parametrize("action_table", ["joint", "factored"])
def test_torch_and_compiled_draw_the_same(exploration: str, tie_break: str, action_table: str) -> None:
    """Both learners use random numbers in the same way, also where the reference does not define it."""
    venvs = [RecordingVecEnv(make_venv(2, shape=(2,))) for _ in LEARNERS]
    models = [
        make_model(
            venv, action_points=TWO, action_table=action_table, exploration=exploration, tie_break=tie_break,
            policy_kwargs=kwargs,
        ).learn(160)
        for venv, kwargs in zip(venvs, LEARNERS.values(), strict=True)
    ]  # fmt: skip
    first, second = (np.array([step.actions for step in venv.steps]) for venv in venvs)
    np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(*map(table, models), rtol=1e-9, atol=1e-9)


# ------------------------------------------------------------------------------------------- exploration


def explore_only(n_steps: int, seed: int = 0, **arguments: Any) -> np.ndarray:
    """The actions in an environment without episode ends, with ε = 1, shape (n_steps, action_dim)."""
    shape = arguments.pop("shape", (1,))
    venv = RecordingVecEnv(make_venv(shape=shape, ends=("never",)))
    everything = {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0, "learning_rate": 0.0, "seed": seed}
    make_model(venv, **{**everything, **arguments}).learn(n_steps)
    return np.array([step.actions[0] for step in venv.steps])


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("hold", [1.0, 5.0])
def test_shared_exploration_holds_a_column(learner: str, hold: float) -> None:
    n = 1200
    actions = explore_only(n, action_points=ONE, exploration_hold=hold, policy_kwargs=LEARNERS[learner])[:, 0]
    nearest = np.abs(actions[:, None] - np.array(ONE)).min(axis=1)
    assert nearest.max() < 1e-12
    # All four are equally likely; the number of draws is about n / hold.
    shares = [np.mean(np.abs(actions - point) < 1e-12) for point in ONE[0]]
    np.testing.assert_allclose(shares, 0.25, atol=4 * math.sqrt(0.19 * 2 * hold / n))
    # One of four draws gives the same column, which is not visible as a change.
    changes = np.mean(np.abs(np.diff(actions)) > 1e-9)
    expected = 0.75 / hold
    assert changes == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / n))


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_default_exploration_hold_is_one_fiftieth_of_an_episode(learner: str, n_envs: int) -> None:
    """The number of draws is as expected from the episode lengths so far."""
    lengths, n_steps = (400, 30, 1200, 300), 4000
    venv = RecordingVecEnv(make_venv(n_envs, lengths=lengths))
    # With so many columns the same one is rarely drawn twice in a row.
    make_model(
        venv, action_points=500, exploration_initial_eps=1.0, exploration_final_eps=1.0, exploration_hold="auto",
        learning_rate=0.0, policy_kwargs=LEARNERS[learner],
    ).learn(n_steps * n_envs)  # fmt: skip
    mean, own = 0.0, [0] * n_envs
    draws, expected, variance = 0, 0.0, 0.0
    for earlier, step in itertools.pairwise(venv.steps):
        ended = earlier.terminated | earlier.truncated
        for env in range(n_envs):
            own[env] += 1
            if ended[env]:
                mean = 0.8 * mean + 0.2 * own[env] if mean else own[env]
                own[env] = 0
        for env in np.flatnonzero(~ended):
            chance = min(1.0, 50.0 / max(mean, own[env]))
            expected, variance = expected + chance, variance + chance * (1.0 - chance)
            draws += int(abs(step.actions[env, 0] - earlier.actions[env, 0]) > 1e-9)
    assert draws == pytest.approx(expected, abs=4 * math.sqrt(variance) + 0.01 * expected)


def test_factored_exploration_draws_each_dimension() -> None:
    arguments: dict[str, Any] = {"shape": (2,), "action_points": TWO, "action_table": "factored"}
    actions = explore_only(2000, exploration_hold=1.0, **arguments)
    seen = {tuple(action) for action in np.round(actions, 9).tolist()}
    assert seen == {(x, y) for x in TWO[0] for y in TWO[1]}
    # Both are drawn at the same time, and persist for the same time.
    held = explore_only(500, exploration_hold=50.0, **arguments)
    assert np.any(np.abs(np.diff(held, axis=0)) > 1e-9, axis=1).mean() < 0.06


@pytest.mark.parametrize("learner", LEARNERS)
def test_an_episode_starts_with_a_new_draw(learner: str) -> None:
    """With a very long hold: constant within an episode, and different between episodes."""
    venv = RecordingVecEnv(make_venv())
    make_model(
        venv, action_points=ONE, exploration_initial_eps=1.0, exploration_final_eps=1.0, exploration_hold=1e12,
        policy_kwargs=LEARNERS[learner],
    ).learn(400)  # fmt: skip
    episodes: list[set[float]] = [set()]
    for step in venv.steps:
        episodes[-1].add(round(float(step.actions[0, 0]), 9))
        if step.terminated[0] or step.truncated[0]:
            episodes.append(set())
    assert all(len(actions) <= 1 for actions in episodes)
    assert set.union(*episodes) == set(ONE[0])


@pytest.mark.parametrize("learner", LEARNERS)
def test_neighbors_that_explore_by_themselves_average_out(learner: str) -> None:
    arguments: dict[str, Any] = {"exploration": "per_neighbor", "policy_kwargs": LEARNERS[learner]}
    few, many = (explore_only(800, n_neighbors=k, **arguments)[:, 0] for k in (1, 9))
    # One neighbour: all action points, equally often. Nine: about a third of the spread, and other values.
    assert {round(float(action), 9) for action in few} == {-1.0, 0.0, 1.0}
    assert few.std() == pytest.approx(math.sqrt(2 / 3), abs=0.06)
    assert many.std() < 0.5 * few.std()
    assert len(np.unique(np.round(many, 9))) > 300


def test_no_exploration_at_epsilon_zero() -> None:
    quiet = {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    np.testing.assert_allclose(explore_only(200, tie_break="first", **quiet), -1.0)


# ------------------------------------------------------------------------------------------ the policy


BOXES: dict[str, dict[str, Any]] = {
    "float32": {"shape": (1,), "low": -2.0, "high": 2.0, "dtype": np.float32},
    # Bounds that float32 cannot represent.
    "odd bounds": {"shape": (2,), "low": -0.1, "high": 0.7, "dtype": np.float32},
    "matrix": {"shape": (2, 2), "dtype": np.float32},
    "float64": {"shape": (3,), "low": 1.1, "high": 3.3},
}


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("action_table", ["joint", "factored"])
def test_actions_lie_in_the_space(learner: str, box: dict[str, Any], action_table: str) -> None:
    model = make_model(
        make_venv(**box), n_neighbors=9, action_table=action_table, policy_kwargs=LEARNERS[learner], tie_break="random"
    )
    space = model.action_space

    @settings(max_examples=15, deadline=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        places=st.lists(st.tuples(*[st.floats(-1e6, 1e6, width=32)] * 2), min_size=1, max_size=9),
    )
    def all_within(seed: int, places: list[tuple[float, float]]) -> None:
        set_random_table(model, seed)
        # Single and batched recommendations must be equal.
        observations = np.array(places, dtype=np.float32)
        for deterministic in (True, False):
            actions, _ = model.predict(observations, deterministic=deterministic)
            assert actions.shape == (len(places), *space.shape)
            assert actions.dtype == space.dtype
            assert all(space.contains(action) for action in actions)
        single, _ = model.predict(observations[0], deterministic=True)
        assert space.contains(single)
        np.testing.assert_array_equal(single, model.predict(observations, deterministic=True)[0][0])

    all_within()
    # PushEnv asserts that its actions are in the action space.
    model.learn(60)


@pytest.mark.parametrize("learner", LEARNERS)
def test_all_neighbours_at_the_edge_stay_within_the_space(learner: str) -> None:
    # Probabilities that sum to 1 + 1e-16 must move an action neither out of the space nor away from its edge.
    model = make_model(make_venv(low=-0.3, high=0.3), n_neighbors=9, policy_kwargs=LEARNERS[learner])
    with th.no_grad():
        model.policy.q_table[:, -1] = 1.0
    observations = np.random.default_rng(0).uniform(*BOUNDS, size=(300, 2)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    assert all(model.action_space.contains(action) for action in actions)
    np.testing.assert_allclose(actions, 0.3, rtol=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    place=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    move=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    learner=st.sampled_from(sorted(LEARNERS)),
)
def test_policy_is_continuous_where_the_neighbours_stay(
    seed: int, place: tuple[float, float], move: tuple[float, float], learner: str
) -> None:
    model = make_model(POLICY_VENV, n_neighbors=4, action_points=ONE, policy_kwargs=LEARNERS[learner])
    set_random_table(model, seed)
    middle, width = DriftEnv.LOW + DriftEnv.HIGH, DriftEnv.HIGH - DriftEnv.LOW
    here = (0.5 * (middle + width * place)).astype(np.float32)
    there = (here + 0.5 * width * move).astype(np.float32)
    perceive = NearestPoints((8, 6), BOUNDS, 4)
    shares = np.zeros((2, perceive.n_points))
    for row, observation in zip(shares, (here, there), strict=True):
        neighbours = perceive(observation)
        row[neighbours.indices] = neighbours.probabilities
    if not np.array_equal(shares[0] > 0, shares[1] > 0):
        return
    before, after = (model.predict(observation, deterministic=True)[0] for observation in (here, there))
    moved = 0.5 * np.abs(shares[0] - shares[1]).sum()
    assert abs(float(after[0] - before[0])) <= (max(ONE[0]) - min(ONE[0])) * moved + 1e-9


POLICY_VENV = make_venv()


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("action_table", ["joint", "factored"])
def test_recommendation_equals_the_reference(learner: str, action_table: str) -> None:
    model = make_model(
        make_venv(shape=(2,)), action_points=TWO, action_table=action_table, policy_kwargs=LEARNERS[learner]
    )
    set_random_table(model, 1)
    reference = ExAAgent(NearestPoints((8, 6), BOUNDS, 4), TWO, factored=action_table == "factored")
    ends = np.cumsum([part.shape[0] for part in reference.parts])[:-1]
    # Its ties go to the first column, as in deterministic predictions with any tie_break.
    reference.tables = np.split(table(model), ends, axis=1)
    observations = np.random.default_rng(0).uniform(*BOUNDS, size=(100, 2)).astype(np.float32)
    expected = [reference.action(reference.recommend(observation)) for observation in observations]
    np.testing.assert_allclose(model.predict(observations, deterministic=True)[0], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(
        model.policy.predict(observations)[0], model.predict(observations, deterministic=True)[0]
    )


def test_random_ties_are_drawn_per_neighbour() -> None:
    model = make_model(make_venv(), n_neighbors=9, tie_break="random")
    model.exploration_rate = 0.0
    # All columns are equal: the first one if deterministic, else a mean of draws.
    observations = np.zeros((400, 2), dtype=np.float32)
    assert set(model.predict(observations, deterministic=True)[0].ravel().tolist()) == {-1.0}
    drawn = model.predict(observations, deterministic=False)[0].ravel()
    assert abs(drawn.mean()) < 0.1
    assert len(np.unique(drawn)) > 100


def test_prediction_explores_at_the_present_rate() -> None:
    model = make_model(make_venv(), tie_break="first")
    observations = np.zeros((2000, 2), dtype=np.float32)
    for rate in (0.0, 0.5, 1.0):
        model.exploration_rate = rate
        actions = model.predict(observations, deterministic=False)[0].ravel()
        # The greedy one is also drawn, one time in three.
        assert np.mean(actions > -0.9) == pytest.approx(rate * 2 / 3, abs=0.05)


# --------------------------------------------------------------------------------------- action points


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (2, [[-1.0, 1.0]] * 2),
        ((3, 2), [[-1.0, 0.0, 1.0], [-1.0, 1.0]]),
        ([np.array([0.2, 0.4]), 2], [[0.2, 0.4], [-1.0, 1.0]]),
        ([[0.5], [-0.5, -0.25, 1]], [[0.5], [-0.5, -0.25, 1.0]]),
        (np.array([2, 3]), [[-1.0, 1.0], [-1.0, 0.0, 1.0]]),
    ],
)  # fmt: skip
def test_action_points(given: Any, expected: list[list[float]]) -> None:
    model = make_model(make_venv(shape=(2,)), action_points=given)
    assert [points.tolist() for points in model.policy.action_points] == expected


@pytest.mark.parametrize("given", [[-0.5, 0.1, 0.2], np.array([-0.5, 0.1, 0.2]), [np.array([-0.5, 0.1, 0.2])]])
def test_one_dimension_takes_the_list_itself(given: Any) -> None:
    assert make_model(action_points=given).policy.action_points[0].tolist() == [-0.5, 0.1, 0.2]


@pytest.mark.parametrize(("dims", "n_columns"), [(1, 3), (4, 81), (5, 15)])
def test_joint_while_it_is_small(dims: int, n_columns: int) -> None:
    model = make_model(make_venv(shape=(dims,)), action_table=None)
    assert model.policy.q_table.shape == (48, n_columns)


def test_a_limit_that_float32_rounds_is_a_valid_action_point() -> None:
    # The limit 0.7 of the space is 0.699999988 in float32.
    model = make_model(make_venv(low=-0.7, high=0.7, dtype=np.float32), action_points=[[-0.7, 0.0, 0.7]])
    np.testing.assert_allclose(model.policy.action_points[0].numpy(), [-0.7, 0.0, 0.7], rtol=1e-6)
    assert "must lie within" in message_of(
        lambda: make_model(make_venv(low=-0.7, high=0.7, dtype=np.float32), action_points=[[-0.7, 0.701]])
    )


def test_hundreds_of_action_dimensions() -> None:
    # More combinations than a float can represent.
    assert make_model(make_venv(shape=(700,))).policy.q_table.shape == (48, 2100)
    assert "'factored'" in message_of(lambda: make_model(make_venv(shape=(700,)), action_table="joint"))


@pytest.mark.parametrize("learner", LEARNERS)
def test_whole_numbers_are_rounded(learner: str) -> None:
    """If all neighbours recommend 10, the action is 10, even if their probabilities sum to slightly less than 1."""
    model = make_model(make_venv(low=0, high=10, dtype=np.int64), n_neighbors=9, policy_kwargs=LEARNERS[learner])
    with th.no_grad():
        model.policy.q_table[:, -1] = 1.0
    observations = np.random.default_rng(0).uniform(*BOUNDS, size=(300, 2)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    assert actions.dtype == np.int64
    np.testing.assert_array_equal(actions, 10)


# ------------------------------------------------------------------------------------ saving and loading


SAVED: dict[str, dict[str, Any]] = {
    "shared": {},
    "long hold": {"exploration_hold": 1e6, "exploration_initial_eps": 0.7, "exploration_final_eps": 0.7},
    "automatic hold": {"exploration_hold": "auto"},
    "per neighbor": {"exploration": "per_neighbor"},
    "factored": {"action_points": TWO, "action_table": "factored"},
    "joint": {"action_points": TWO, "action_table": "joint"},
    "accumulating": {"traces": "accumulating", "learning_rate": 0.05},
}


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("given", SAVED.values(), ids=SAVED)
def test_interrupted_run_equals_the_uninterrupted(
    tmp_path: pathlib.Path, learner: str, n_envs: int, given: dict[str, Any]
) -> None:
    arguments = {"policy_kwargs": LEARNERS[learner], **given}
    venvs = [RecordingVecEnv(make_venv(n_envs, shape=(2,))) for _ in range(2)]
    # In the middle of an episode, because 101 is not a sum of episode lengths.
    whole = make_model(venvs[0], **arguments).learn(101 * n_envs).learn(100, reset_num_timesteps=False)
    make_model(venvs[1], **arguments).learn(101 * n_envs).save(tmp_path / "middle")
    resumed = ExA.load(tmp_path / "middle", env=venvs[1], force_reset=False).learn(100, reset_num_timesteps=False)
    assert th.equal(resumed.policy.q_table, whole.policy.q_table)
    assert resumed.num_timesteps == whole.num_timesteps
    for first, second in zip(venvs[0].steps, venvs[1].steps, strict=True):
        np.testing.assert_array_equal(first.actions, second.actions)
    observations = np.zeros((5, 2), dtype=np.float32)
    np.testing.assert_array_equal(resumed.predict(observations)[0], whole.predict(observations)[0])


def test_a_file_goes_from_one_learner_to_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The persistent action is kept in the middle of an episode, if numba is no longer available."""
    venvs = [make_venv(2) for _ in range(2)]
    whole = make_model(venvs[0]).learn(90).learn(90, reset_num_timesteps=False)
    file = io.BytesIO()
    make_model(venvs[1]).learn(90).save(file)
    file.seek(0)
    monkeypatch.setattr("sb3_knntd.kernels.jit.AVAILABLE", False)
    with pytest.warns(UserWarning, match="numba"):
        resumed = ExA.load(file, env=venvs[1], force_reset=False)
    assert not resumed.policy.is_compiled
    resumed.learn(90, reset_num_timesteps=False)
    np.testing.assert_allclose(table(resumed), table(whole), rtol=1e-9, atol=1e-9)


def test_files_of_the_other_algorithm_are_refused(tmp_path: pathlib.Path) -> None:
    make_model().save(tmp_path / "exa")
    KNNTD(DriftEnv(), points=(8, 6), bounds=BOUNDS).save(tmp_path / "knntd")
    for cls, name, holds in ((ExA, "knntd", "KNNTD"), (KNNTD, "exa", "ExA")):
        message = message_of(lambda cls=cls, name=name: cls.load(tmp_path / name))  # type: ignore[misc]
        assert f"holds a model of {holds}, not of {cls.__name__}" in message


# ----------------------------------------------------------------------- ranges, environments, precision


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("action_table", ["joint", "factored"])
def test_unbounded_observations_are_measured(learner: str, action_table: str) -> None:
    venv = RecordingVecEnv(make_venv(2, shape=(2,), unbounded=True))
    model = make_model(
        venv, bounds=None, points=5, action_points=TWO, action_table=action_table, policy_kwargs=LEARNERS[learner]
    ).learn(900)
    assert not model.policy.q_table.any()
    # While measuring, the actions are random action points, not means of them.
    assert {tuple(action) for step in venv.steps for action in np.round(step.actions, 9).tolist()} == {
        (x, y) for x in TWO[0] for y in TWO[1]
    }
    model.learn(600, reset_num_timesteps=False)
    assert model.policy.q_table.any()
    seen = np.concatenate([step.arrived for step in venv.steps[:500]])
    low, high = model.policy.points.min(dim=0).values.numpy(), model.policy.points.max(dim=0).values.numpy()
    assert (low <= seen.min(axis=0) + 1e-6).all()
    assert (high >= seen.max(axis=0) - 1e-6).all()


def test_the_papers_cart_pole() -> None:
    model = ExA("sb3_knntd/ContinuousCartPole-v0", seed=0).learn(1500)
    assert model.policy.q_table.any()
    assert isinstance(evaluate_policy(model, gym.make("sb3_knntd/ContinuousCartPole-v0"), 1, warn=False)[0], float)


def test_single_precision() -> None:
    venvs = [make_venv(lengths=(25,), ends=("terminated",)) for _ in LEARNERS]
    models = [
        make_model(venv, tie_break="first", policy_kwargs={"dtype": th.float32, **kwargs}).learn(75)
        for venv, kwargs in zip(venvs, LEARNERS.values(), strict=True)
    ]
    assert all(model.policy.q_table.dtype == th.float32 for model in models)
    np.testing.assert_allclose(*map(table, models), rtol=1e-3, atol=1e-3)


# ------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"action_points": 1}, ["action_points", ">= 2"]),
        ({"action_points": 2.5}, ["action_points", "2.5"]),
        ({"action_points": None}, ["action_points", "None"]),
        ({"action_points": True}, ["action_points", "True"]),
        ({"action_points": "many"}, ["action_points", "'many'"]),
        ({"action_points": []}, ["action_points", "2 action dimensions", "got 0"]),
        ({"action_points": [3]}, ["action_points", "2 action dimensions", "got 1"]),
        ({"action_points": (3, 3, 3)}, ["action_points", "2 action dimensions", "got 3"]),
        ({"action_points": (3, 1)}, ["action_points of dimension 1", ">= 2"]),
        ({"action_points": [[], [0.0]]}, ["action_points of dimension 0", "at least one"]),
        ({"action_points": [[0.0], [0.5, 0.1]]}, ["action_points of dimension 1", "must rise", "[0.5, 0.1]"]),
        ({"action_points": [[0.0, 0.0], 3]}, ["action_points of dimension 0", "must rise"]),
        ({"action_points": [[0.0], [0.5, 1.5]]}, ["action_points of dimension 1", "[-1, 1]", "1.5"]),
        ({"action_points": [[-2.0, 0.0], 2]}, ["action_points of dimension 0", "[-1, 1]", "-2.0"]),
        ({"action_points": [[float("nan")], 2]}, ["action_points of dimension 0", "nan"]),
        ({"action_points": [["left"], 2]}, ["action_points of dimension 0", "numbers", "left"]),
        ({"action_table": "both"}, ["action_table", "'joint'", "'factored'", "'both'"]),
        ({"action_table": "joint", "action_points": 1200}, ["1,440,000 columns", "2 action dimensions", "'factored'"]),
        ({"exploration": "softmax"}, ["exploration", "'shared'", "'per_neighbor'", "'softmax'"]),
        ({"exploration_hold": 0.5}, ["exploration_hold", "[1, 1e+15]", "0.5"]),
        ({"exploration_hold": 1e308}, ["exploration_hold", "[1, 1e+15]", "1e+308"]),
        ({"exploration_hold": b"2"}, ["exploration_hold", "[1, 1e+15]"]),
        ({"action_points": 1j}, ["action_points", ">= 2"]),
        ({"action_points": [["-1", "1"], 2]}, ["action_points", "numbers"]),
        ({"action_points": [[False, True], 2]}, ["action_points", "numbers"]),
        ({"exploration_hold": float("nan")}, ["exploration_hold", "nan"]),
        ({"exploration_hold": "long"}, ["exploration_hold", "'auto'", "'long'"]),
        ({"exploration_initial_eps": 1.1}, ["exploration_initial_eps", "[0, 1]", "1.1"]),
        ({"exploration_final_eps": -0.1}, ["exploration_final_eps", "[0, 1]", "-0.1"]),
        ({"exploration_fraction": 0.0}, ["exploration_fraction", "(0, 1]", "0.0"]),
        ({"tie_break": "last"}, ["tie_break", "'first'", "'last'"]),
        ({"step_size": "large"}, ["step_size", "'normalized'", "'large'"]),
        ({"policy_kwargs": {"action_points": 5}}, ["policy_kwargs", "'action_points'"]),
    ],
)
def test_error_names_argument_value_and_valid_values(arguments: dict[str, Any], says: list[str]) -> None:
    message = message_of(lambda: make_model(make_venv(shape=(2,)), **arguments))
    for words in says:
        assert words in message


def test_discrete_actions_are_for_the_other_algorithm() -> None:
    message = message_of(lambda: ExA(DriftEnv()))
    assert "ExA takes actions in a Box space; got Discrete(3)" in message
    assert "use KNNTD" in message
    assert "ExA" in message_of(lambda: KNNTD(PushEnv()))


def test_infinite_action_bounds() -> None:
    message = message_of(lambda: ExA(PushEnv(low=-np.inf, high=np.inf)))
    assert "finite bounds" in message
    assert "inf" in message
    assert "ActionWrapper" in message


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_a_network_is_refused(policy: str) -> None:
    message = message_of(lambda: ExA(policy, PushEnv()))
    assert f"ExA has no {policy!r}" in message
    assert 'ExA("KNNPolicy", env)' in message


# ------------------------------------------------------------------------------------------- learning


def test_pendulum_is_better_than_random() -> None:
    """Random actions have a return of about -1200."""
    returns = []
    for seed in range(3):
        model = ExA(
            "Pendulum-v1", points=(7, 7, 9), gamma=0.95, trace_decay=0.6, action_points=2, exploration_initial_eps=0.5,
            seed=seed,
        ).learn(10_000)  # fmt: skip
        env = Monitor(gym.make("Pendulum-v1"))
        env.reset(seed=1_000)
        returns.append(evaluate_policy(model, env, 10, deterministic=True)[0])
    assert float(np.median(np.array(returns))) > -900.0, returns
