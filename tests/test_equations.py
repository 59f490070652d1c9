"""The package against `examples/knn_td_from_scratch.py`: the same perceptions, the same choices, the same table.

A run is recorded at the interface between learner and environments, and replayed through the reference with the
recorded actions. In a greedy run the reference must also select the same action in every step.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from knn_td_from_scratch import (
    ExactStates,
    KNNTDAgent,
    NearestPoints,
    Rates,
    Transition,
    lattice,
    make_perceiver,
    shared_step,
)
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import DriftEnv, EpisodeEnv, GridEnv, RecordingVecEnv, ScriptedEnv, StillEnv, VecStep

from sb3_knntd import KNNTD

# Every way to the same answer: a name and the arguments of KNNTD that choose it.
VARIANTS: dict[str, dict[str, Any]] = {
    "torch brute": {"search": "brute", "policy_kwargs": {"compiled": False}},
    "torch lattice": {"search": "lattice", "policy_kwargs": {"compiled": False}},
    "compiled brute": {"search": "brute"},
    "compiled lattice": {"search": "lattice"},
    "torch kd_tree": {"search": "kd_tree", "policy_kwargs": {"compiled": False}},
    "compiled kd_tree": {"search": "kd_tree"},
}
# A variant that supports only some kinds of points, spaces or weights lists them here: "lattice", "scattered",
# "discrete", "inverse_quadratic", "gaussian", "callable". The others support all.
SERVES: dict[str, set[str]] = {
    "torch lattice": {"lattice", "inverse_quadratic", "gaussian", "callable"},
    "compiled brute": {"lattice", "scattered", "discrete", "inverse_quadratic", "gaussian"},
    "compiled lattice": {"lattice", "inverse_quadratic", "gaussian"},
    "torch kd_tree": {"scattered", "inverse_quadratic", "gaussian", "callable"},
    "compiled kd_tree": {"lattice", "scattered", "inverse_quadratic", "gaussian"},
}

# The variants whose learning differs. A search only finds the neighbours, so tests of learning need not be run once
# more for every search: one test for all of them, and those of perception, see that the neighbours are right.
LEARNERS: dict[str, list[str]] = {
    "lattice": ["torch brute", "compiled lattice"],
    "scattered": ["torch brute", "compiled brute"],
    "discrete": ["torch brute", "compiled brute"],
}

DRIFT_BOUNDS = (DriftEnv.LOW, DriftEnv.HIGH)
# 40 irregular points, some of them outside the bounds.
SCATTERED = np.random.default_rng(5).uniform(
    DriftEnv.LOW - 0.05 * (DriftEnv.HIGH - DriftEnv.LOW), DriftEnv.HIGH, size=(40, 2)
)
POINTS: dict[str, Any] = {"lattice": (8, 6), "scattered": SCATTERED}

EnvMaker = Callable[[], gym.Env[Any, Any]]


def variants(*needs: str) -> list[str]:
    """The names of all variants that support the requirements."""
    return [name for name in VARIANTS if all(name not in SERVES or need in SERVES[name] for need in needs)]


def learners(*needs: str) -> list[str]:
    """The names of the variants that learn in different ways; the first requirement is the kind of points or space."""
    return [name for name in variants(*needs) if name in LEARNERS[needs[0]]]


# Pairs of variant and points, for the tests that run on both kinds of points.
ON_POINTS = [(variant, kind) for kind in POINTS for variant in variants(kind)]
LEARNING_ON_POINTS = [(variant, kind) for kind in POINTS for variant in learners(kind)]


# ------------------------------------------------------------------------------------- record and replay


def make_model(env: Any, variant: str, **arguments: Any) -> KNNTD:
    """A model without default arguments, because defaults may change."""
    chosen: dict[str, Any] = {
        "learning_rate": 0.5,
        "gamma": 0.5,
        "trace_decay": 0.5,
        "weights": "inverse_quadratic",
        "bandwidth": 1.0,
        "step_size": "paper",
        "traces": "replacing",
        "reset_other_actions": False,
        "target": "sarsa",
        "exploration": "epsilon_greedy",
        "exploration_initial_eps": 0.0,
        "exploration_final_eps": 0.0,
        "tie_break": "first",
        "initial_value": 0.0,
        "seed": 0,
    }
    chosen.update(arguments)
    # Both may contain policy_kwargs.
    policy_kwargs = {**chosen.pop("policy_kwargs", {}), **VARIANTS[variant].get("policy_kwargs", {})}
    return KNNTD(env=env, **{**chosen, **VARIANTS[variant], "policy_kwargs": policy_kwargs})


def record(makers: Sequence[EnvMaker], n_steps: int, variant: str, **arguments: Any) -> tuple[KNNTD, RecordingVecEnv]:
    """A model trained for ``n_steps``, and the record of its interaction with the environments."""
    venv = RecordingVecEnv(DummyVecEnv(list(makers)))
    model = make_model(venv, variant, **arguments)
    model.learn(n_steps)
    assert len(venv.steps) == -(-n_steps // len(makers))
    return model, venv


def make_reference(
    venv: RecordingVecEnv,
    *,
    gamma: float,
    target: str = "sarsa",
    traces: str = "replacing",
    reset_other_actions: bool = False,
    step_size: str = "paper",
    exploration: str = "epsilon_greedy",
    initial_value: float = 0.0,
    learning_rate: Any = None,
    trace_decay: Any = None,
    temperature: Any = None,
    exploration_initial_eps: float = 0.0,
    exploration_final_eps: float = 0.0,
    exploration_fraction: float = 0.0,
    policy_kwargs: Any = None,
    **perception: Any,
) -> KNNTDAgent:
    """The reference for the same arguments; time-dependent ones are handled by `rates_at`, the precision is ignored."""
    return KNNTDAgent(
        make_perceiver(venv.observation_space, **perception),
        int(venv.action_space.n),  # type: ignore[attr-defined]
        venv.num_envs,
        gamma=gamma,
        target=target,
        traces=traces,
        reset_other_actions=reset_other_actions,
        step_size=step_size,
        exploration=exploration,
        initial_value=initial_value,
    )


def rates_at(progress_remaining: float, arguments: dict[str, Any]) -> Rates:
    """The rates at a step, from numbers or schedules."""

    def now(value: Any) -> float:
        return float(value(progress_remaining) if callable(value) else value)

    epsilon = LinearSchedule(
        arguments.get("exploration_initial_eps", 0.0),
        arguments.get("exploration_final_eps", 0.0),
        arguments.get("exploration_fraction", 1.0),
    )
    return Rates(
        now(arguments["learning_rate"]),
        now(arguments["trace_decay"]),
        now(epsilon),
        now(arguments.get("temperature", 1.0)),
    )


def transitions(steps: Sequence[VecStep]) -> Iterator[list[Transition]]:
    """A record as transitions of the reference; the action after the end of an episode or of the record is open."""
    for number, step in enumerate(steps):
        together = []
        for env in range(len(step.actions)):
            ended = bool(step.terminated[env] or step.truncated[env])
            known = number + 1 < len(steps) and not ended
            together.append(
                Transition(
                    state=step.observations[env],
                    action=int(step.actions[env]),
                    reward=float(step.rewards[env]),
                    next_state=step.arrived[env],
                    terminated=bool(step.terminated[env]),
                    truncated=bool(step.truncated[env]),
                    next_action=int(steps[number + 1].actions[env]) if known else None,
                )
            )
        yield together


def replay(venv: RecordingVecEnv, n_steps: int, *, greedy: bool, **arguments: Any) -> KNNTDAgent:
    """The reference after the recorded steps.

    :param greedy: whether the run did not explore, so that the reference must select each recorded action; it selects
        with the table at the time of the observation, before the update by the step that led there
    """
    learner = make_reference(venv, **arguments)
    steps = list(transitions(venv.steps))
    for number, together in enumerate(steps):
        if greedy and number == 0:
            assert [step.action for step in together] == [learner.greedy_action(s.state) for s in together]
        own = None
        if greedy and number + 1 < len(steps):
            own = [learner.greedy_action(step.state) for step in steps[number + 1]]
        learner.learn(together, rates_at(1.0 - (number + 1) * venv.num_envs / n_steps, arguments))
        if own is not None:
            assert [step.action for step in steps[number + 1]] == own, f"choice after step {number}"
    return learner


def table(model: KNNTD) -> np.ndarray:
    return model.policy.q_table.detach().cpu().numpy().copy()


def set_table(model: KNNTD, values: np.ndarray) -> None:
    with torch.no_grad():
        model.policy.q_table.copy_(torch.as_tensor(values))


def assert_same_table(model: KNNTD, learner: KNNTDAgent, tolerance: float = 1e-9) -> None:
    got, expected = table(model), learner.q_table
    # Equal tables prove nothing if nothing was learned or the values diverged.
    assert np.isfinite(expected).all()
    assert 1e-3 < np.abs(expected - expected.flat[0]).max() < 1e6
    assert got.shape == expected.shape
    np.testing.assert_allclose(got, expected, rtol=tolerance, atol=tolerance)


def check(
    makers: Sequence[EnvMaker],
    n_steps: int,
    variant: str,
    *,
    greedy: bool = True,
    tolerance: float = 1e-9,
    **arguments: Any,
) -> RecordingVecEnv:
    """Record, replay and compare; returns the record for further checks."""
    model, venv = record(makers, n_steps, variant, **arguments)
    learner = replay(venv, n_steps, greedy=greedy, **arguments)
    assert_same_table(model, learner, tolerance)
    return venv


def drift(**arguments: Any) -> dict[str, Any]:
    """Arguments of DriftEnv, with some of them changed."""
    base = {
        "learning_rate": 0.2,
        "gamma": 0.97,
        "trace_decay": 0.8,
        "n_neighbors": 4,
        "points": POINTS["lattice"],
        "bounds": DRIFT_BOUNDS,
    }
    return {**base, **arguments}


# ------------------------------------------------------------------------------------------ learning alone


@pytest.mark.parametrize(("variant", "points"), LEARNING_ON_POINTS)
@pytest.mark.parametrize("n_neighbors", [1, 4, 9])
@pytest.mark.parametrize("trace_decay", [0.0, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("step_size", ["paper", "normalized"])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("target", ["sarsa", "q_learning"])
def test_same_table(
    variant: str,
    points: str,
    n_neighbors: int,
    trace_decay: float,
    step_size: str,
    traces: str,
    target: str,
) -> None:
    # With a larger step size long accumulating traces overshoot, and the result depends on rounding.
    learning_rate = 0.05 if traces == "accumulating" else 0.3
    arguments = drift(
        learning_rate=learning_rate,
        trace_decay=trace_decay,
        n_neighbors=n_neighbors,
        points=POINTS[points],
        step_size=step_size,
        traces=traces,
        target=target,
    )
    venv = check([DriftEnv], 150, variant, **arguments)
    for what in ("terminated", "truncated"):
        assert sum(getattr(step, what).sum() for step in venv.steps) > 5
    assert len({int(step.actions[0]) for step in venv.steps}) == 3


@pytest.mark.parametrize(("variant", "points"), ON_POINTS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_every_search_supports_learning(variant: str, points: str, n_envs: int) -> None:
    makers = [lambda n=n: DriftEnv(offset=0.3 * n) for n in range(n_envs)]
    check(makers, 300, variant, **drift(points=POINTS[points]))


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("reset_other_actions", [False, True])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("epsilon", [0.0, 0.5])
def test_reset_other_actions(variant: str, reset_other_actions: bool, traces: str, epsilon: float) -> None:
    # Q-learning, so that actions that were selected but never taken do not matter.
    check(
        [DriftEnv],
        300,
        variant,
        greedy=epsilon == 0.0,
        **drift(
            traces=traces,
            reset_other_actions=reset_other_actions,
            target="q_learning",
            trace_decay=0.95,
            learning_rate=0.1,
            exploration_initial_eps=epsilon,
            exploration_final_eps=epsilon,
        ),
    )


@pytest.mark.parametrize("variant", learners("lattice"))
def test_reset_other_actions_needs_replacing_traces(variant: str) -> None:
    def learned(traces: str, reset: bool) -> np.ndarray:
        arguments = drift(traces=traces, reset_other_actions=reset, trace_decay=0.95, learning_rate=0.1)
        return table(record([DriftEnv], 300, variant, **arguments)[0])

    np.testing.assert_array_equal(learned("accumulating", True), learned("accumulating", False))
    assert np.abs(learned("replacing", True) - learned("replacing", False)).max() > 1e-3


def sharp(squared: Any) -> Any:
    """A user-defined weight function for arrays of any type."""
    return 1.0 / (0.02 + squared)


@pytest.mark.parametrize(
    ("variant", "points", "weights", "bandwidth"),
    [
        (variant, kind, weights, bandwidth)
        for weights, bandwidth in [
            ("inverse_quadratic", 0.3),
            ("inverse_quadratic", 2.0),
            ("gaussian", 0.2),
            ("gaussian", 1.5),
            (sharp, 1.0),
        ]
        for kind in POINTS
        for variant in learners(kind, weights if isinstance(weights, str) else "callable")
    ],
)
def test_weights(variant: str, points: str, weights: Any, bandwidth: float) -> None:
    check([DriftEnv], 300, variant, **drift(points=POINTS[points], weights=weights, bandwidth=bandwidth))


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
@pytest.mark.parametrize("initial_value", [2.0, -20.0])
def test_initial_value(variant: str, target: str, initial_value: float) -> None:
    # Action values that no step has distinguished are equal up to rounding, so the choices are only
    # replayed. `test_equal_values_are_a_tie` tests ties.
    arguments = drift(target=target, initial_value=initial_value, exploration_initial_eps=0.0)
    check([lambda: DriftEnv(lengths=(25,), ends=("terminated",))], 300, variant, greedy=False, **arguments)


class ManyActionsEnv(DriftEnv):
    """Seven actions, so that a vectorised sum treats the last ones differently."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = gym.spaces.Discrete(7)


@pytest.mark.parametrize(("variant", "points"), LEARNING_ON_POINTS)
@pytest.mark.parametrize("initial_value", [0.0, 0.1, -7.3])
def test_equal_values_are_a_tie(variant: str, points: str, initial_value: float) -> None:
    arguments = drift(points=POINTS[points], n_neighbors=9, initial_value=initial_value, learning_rate=0.0)
    model, venv = record([ManyActionsEnv], 50, variant, **arguments)
    assert {int(step.actions[0]) for step in venv.steps} == {0}
    observations = np.random.default_rng(0).uniform(*DRIFT_BOUNDS, size=(50, 2)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(actions, 0)


@pytest.mark.parametrize("variant", learners("lattice"))
def test_single_precision(variant: str) -> None:
    # Rounding may break near ties, so the choices are only replayed.
    makers = [lambda: DriftEnv(lengths=(25,), ends=("terminated",))]
    arguments = drift(policy_kwargs={"dtype": torch.float32})
    model, venv = record(makers, 300, variant, **arguments)
    assert model.policy.q_table.dtype == torch.float32
    assert_same_table(model, replay(venv, 300, greedy=False, **arguments), tolerance=1e-4)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
def test_a_table_of_the_visited_points_only(n_envs: int, traces: str) -> None:
    arguments = drift(policy_kwargs={"table": "hashed"}, traces=traces, learning_rate=0.1, initial_value=-3.0)
    # The last episode ends with the record, so that every selected action is taken.
    makers = [lambda n=n: DriftEnv(offset=0.3 * n, lengths=(25,), ends=("terminated",)) for n in range(n_envs)]
    model, venv = record(makers, 300 * n_envs, "compiled lattice", **arguments)
    learner = replay(venv, 300 * n_envs, greedy=False, **arguments)
    anywhere = np.random.default_rng(0).uniform(*DRIFT_BOUNDS, size=(200, 2)).astype(np.float32)
    observations = np.concatenate([anywhere, *[step.observations for step in venv.steps]])
    expected = np.array([learner.q_values(observation) for observation in observations])
    np.testing.assert_allclose(model.policy.q_values(observations).numpy(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("variant", learners("lattice"))
def test_double_precision_unless_asked_otherwise(variant: str) -> None:
    model = make_model(DriftEnv(), variant, points=(4, 4), bounds=DRIFT_BOUNDS)
    assert model.policy.q_table.dtype == torch.float64


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("end", ["terminated", "truncated", "both"])
@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
def test_ends_of_episodes(variant: str, end: str, target: str) -> None:
    # Include episodes of one step, which end before anything is perceived twice.
    makers = [lambda: DriftEnv(lengths=(1, 5, 2, 17), ends=(end,))]
    check(makers, 200, variant, **drift(target=target, trace_decay=0.9))


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_gamma_one_and_a_long_episode(variant: str, end: str) -> None:
    # Traces that do not decay for hundreds of steps, or decay far below rounding.
    for trace_decay in (1.0, 0.7):
        makers = [lambda: DriftEnv(lengths=(700,), ends=(end,))]
        check(makers, 1000, variant, **drift(gamma=1.0, trace_decay=trace_decay, learning_rate=0.05))


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("gamma", [0.0, 0.5])
def test_small_gamma(variant: str, gamma: float) -> None:
    check([DriftEnv], 300, variant, **drift(gamma=gamma, trace_decay=1.0))


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
def test_learning_in_two_calls_is_learning_in_one(variant: str, traces: str, target: str) -> None:
    # The second call continues in the middle of an episode, with its traces and the selected action.
    arguments = drift(traces=traces, target=target, trace_decay=0.9, learning_rate=0.1)
    venv = RecordingVecEnv(DummyVecEnv([DriftEnv]))
    model = make_model(venv, variant, **arguments)
    model.learn(103)
    model.learn(97, reset_num_timesteps=False)
    assert len(venv.steps) == 200
    assert_same_table(model, replay(venv, 200, greedy=True, **arguments))


@pytest.mark.parametrize("variant", learners("lattice"))
def test_predict_is_greedy_on_what_was_learned(variant: str) -> None:
    arguments = drift()
    model, venv = record([DriftEnv], 300, variant, **arguments)
    learner = replay(venv, 300, greedy=True, **arguments)
    observations = np.concatenate([step.observations for step in venv.steps])
    actions, _ = model.predict(observations, deterministic=True)
    values = np.array([learner.q_values(observation) for observation in observations])
    np.testing.assert_allclose(model.policy.q_values(observations).numpy(), values, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(actions, values.argmax(axis=1))


# ------------------------------------------------------------------------------------------ other spaces


@pytest.mark.parametrize("variant", learners("discrete"))
@pytest.mark.parametrize("kind", ["discrete", "multi_discrete"])
@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
def test_finite_spaces(variant: str, kind: str, target: str, traces: str) -> None:
    arguments: dict[str, Any] = {
        "learning_rate": 0.2,
        "gamma": 0.95,
        "trace_decay": 0.8,
        "target": target,
        "traces": traces,
    }
    check([lambda: GridEnv(kind)], 300, variant, **arguments)


@pytest.mark.parametrize("variant", learners("discrete"))
@pytest.mark.parametrize("kind", ["discrete", "multi_discrete"])
def test_finite_spaces_with_several_envs(variant: str, kind: str) -> None:
    makers = [lambda n=n: GridEnv(kind, lengths=(4 + n, 11)) for n in range(3)]
    check(makers, 600, variant, learning_rate=0.2, gamma=0.95, trace_decay=0.8, target="q_learning")


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("dtype", [np.int64, np.int32, np.int8, np.uint8])
@pytest.mark.parametrize("n_neighbors", [1, 2, 4, 7])
def test_integer_observations(variant: str, dtype: Any, n_neighbors: int) -> None:
    # Lattice planes are two cells apart: half of all observations are exactly between points, at equal distances.
    arguments: dict[str, Any] = {
        "learning_rate": 0.2,
        "gamma": 0.95,
        "trace_decay": 0.8,
        "n_neighbors": n_neighbors,
        "points": (5, 3),
        "bounds": (np.array([0, 0]), np.array([8, 4])),
        "target": "sarsa",
    }
    check([lambda: GridEnv("box", dtype=dtype)], 200, variant, **arguments)


@pytest.mark.parametrize("variant", learners("scattered"))
def test_integer_observations_on_scattered_points(variant: str) -> None:
    # Points half-way between cells, so that every observation has neighbours at equal distances.
    points = np.array([[x + 0.5, y + 0.5] for x in range(0, 8, 2) for y in range(0, 4, 2)])
    arguments: dict[str, Any] = {
        "learning_rate": 0.2,
        "gamma": 0.95,
        "trace_decay": 0.8,
        "n_neighbors": 3,
        "points": points[np.random.default_rng(1).permutation(len(points))],
        "bounds": (np.array([0, 0]), np.array([8, 4])),
    }
    check([lambda: GridEnv("box")], 400, variant, **arguments)


# --------------------------------------------------------------------------------- schedules, exploration


def falling(progress_remaining: float) -> float:
    return 0.02 + 0.4 * progress_remaining**2


def rising(progress_remaining: float) -> float:
    return 0.95 - 0.6 * progress_remaining


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(
    "scheduled",
    [
        {"learning_rate": falling},
        {"trace_decay": rising},
        {"learning_rate": falling, "trace_decay": rising, "step_size": "normalized"},
        {"learning_rate": LinearSchedule(0.5, 0.1, 0.4)},
    ],
)
def test_schedules(variant: str, n_envs: int, scheduled: dict[str, Any]) -> None:
    makers = [lambda n=n: DriftEnv(offset=0.3 * n) for n in range(n_envs)]
    check(makers, 300, variant, **drift(**scheduled))


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("target", ["q_learning", "expected_sarsa"])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_exploration(variant: str, target: str, traces: str, n_envs: int) -> None:
    # Exploratory actions do not cut traces. The expectation uses the scheduled epsilon.
    makers = [lambda n=n: DriftEnv(offset=0.3 * n) for n in range(n_envs)]
    venv = check(
        makers,
        600,
        variant,
        greedy=False,
        **drift(
            target=target,
            traces=traces,
            trace_decay=0.9,
            learning_rate=0.1,
            exploration_initial_eps=0.9,
            exploration_final_eps=0.2,
            exploration_fraction=0.6,
        ),
    )
    taken = np.concatenate([step.actions for step in venv.steps])
    assert np.bincount(taken, minlength=3).min() > 30


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("target", ["sarsa", "q_learning", "expected_sarsa"])
@pytest.mark.parametrize("temperature", [0.5, falling])
def test_softmax(variant: str, target: str, temperature: Any) -> None:
    # All episodes terminate, the last one with the record, so that every selected action is taken.
    check(
        [lambda: DriftEnv(lengths=(7, 13), ends=("terminated",))],
        300,
        variant,
        greedy=False,
        **drift(target=target, exploration="softmax", temperature=temperature),
    )


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("n_envs", [1, 3])
def test_sarsa_learns_from_the_next_action(variant: str, n_envs: int) -> None:
    # As above: after a termination the target does not depend on the next action.
    makers = [
        lambda length=length, n=n: DriftEnv(offset=0.3 * n, lengths=(length,), ends=("terminated",))
        for n, length in enumerate((25, 10, 50)[:n_envs])
    ]
    arguments = drift(exploration_initial_eps=0.6, exploration_final_eps=0.6)
    check(makers, 300 * n_envs, variant, greedy=False, **arguments)


@pytest.mark.parametrize("variant", learners("lattice"))
def test_sarsa_at_a_truncation_uses_an_exploratory_action(variant: str) -> None:
    # The action selected at the last observation is never taken, so it is not in the record. Exactly one
    # assignment of actions to these steps must explain the table, and it must not always be the greedy one.
    explored = 0
    arguments = drift(exploration_initial_eps=1.0, exploration_final_eps=1.0, learning_rate=0.5)
    # All values differ, so that different assignments give different tables.
    start = np.random.default_rng(4).normal(size=(48, 3))
    for seed in range(3):
        ends = ("truncated", "terminated", "truncated", "truncated")
        venv = RecordingVecEnv(DummyVecEnv([lambda ends=ends: DriftEnv(lengths=(6,), ends=ends)]))
        model = make_model(venv, variant, **{**arguments, "seed": seed})
        set_table(model, start)
        model.learn(24)
        hidden = [n for n, step in enumerate(venv.steps) if step.truncated[0]]
        assert hidden == [5, 17, 23]
        explanations = []
        for guess in itertools.product(range(3), repeat=len(hidden)):
            learner = make_reference(venv, **arguments)
            learner.q_table[:] = start
            greedy = []
            for number, (step,) in enumerate(transitions(venv.steps)):
                if number in hidden:
                    greedy.append(learner.greedy_action(step.next_state))
                    step = replace(step, next_action=guess[hidden.index(number)])
                learner.learn([step], rates_at(0.0, arguments))
            if np.allclose(table(model), learner.q_table, rtol=1e-9, atol=1e-9):
                explanations.append((guess, tuple(greedy)))
        assert len(explanations) == 1, f"seed {seed}: {len(explanations)} explanations"
        explored += explanations[0][0] != explanations[0][1]
    assert explored > 0


# ------------------------------------------------------------------------------------------- several envs


def unequal_drifts(n_envs: int) -> list[EnvMaker]:
    """Environments with different episode lengths: very short ones in the first, very long ones in the last."""
    lengths = [(3,), *[(9 + n, 14 - n) for n in range(n_envs - 2)], (40,)]
    ends = [("terminated", "truncated"), ("truncated", "terminated", "both")]
    return [
        lambda n=n, length=length: DriftEnv(offset=0.17 * n, lengths=length, ends=ends[n % 2])
        for n, length in enumerate(lengths)
    ]


@pytest.mark.parametrize(("variant", "points"), LEARNING_ON_POINTS)
@pytest.mark.parametrize("n_envs", [3, 8])
@pytest.mark.parametrize("step_size", ["paper", "normalized"])
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
@pytest.mark.parametrize("trace_decay", [0.0, 0.95])
def test_envs_share_one_table(
    variant: str, points: str, n_envs: int, step_size: str, traces: str, trace_decay: float
) -> None:
    venv = check(
        unequal_drifts(n_envs),
        60 * n_envs,
        variant,
        **drift(
            points=POINTS[points],
            step_size=step_size,
            traces=traces,
            trace_decay=trace_decay,
            learning_rate=0.1,
        ),
    )
    endings = np.sum([step.terminated | step.truncated for step in venv.steps], axis=0)
    assert endings[0] > 15
    assert endings[-1] == 1


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("target", ["q_learning", "expected_sarsa"])
@pytest.mark.parametrize("reset_other_actions", [False, True])
def test_envs_share_one_table_and_explore(variant: str, target: str, reset_other_actions: bool) -> None:
    arguments = drift(
        target=target,
        reset_other_actions=reset_other_actions,
        trace_decay=0.95,
        learning_rate=falling,
        exploration_initial_eps=0.8,
        exploration_final_eps=0.1,
        exploration_fraction=0.5,
    )
    check(unequal_drifts(8), 1600, variant, greedy=False, **arguments)


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize("traces", ["replacing", "accumulating"])
def test_equal_envs_learn_as_one(variant: str, traces: str) -> None:
    # Eight copies of one environment have the same information as one, and must not make a larger update.
    arguments = drift(traces=traces, learning_rate=0.1)
    one, _ = record([DriftEnv], 200, variant, **arguments)
    eight, _ = record([DriftEnv] * 8, 1600, variant, **arguments)
    np.testing.assert_allclose(table(eight), table(one), rtol=1e-9, atol=1e-9)


def test_shared_step_of_one_env_is_equation_14() -> None:
    rng = np.random.default_rng(3)
    traces = rng.uniform(size=(1, 6, 2)) * (rng.uniform(size=(1, 6, 2)) < 0.5)
    np.testing.assert_array_equal(shared_step(traces, np.array([0.7])), 0.7 * traces[0])


# --------------------------------------------------------------------------------------- worked by hand

LINE: dict[str, Any] = {
    "points": (3,),
    "bounds": ([0.0], [4.0]),
    "n_neighbors": 2,
    "learning_rate": 0.5,
    "gamma": 0.5,
    "trace_decay": 0.5,
}


@pytest.mark.parametrize("variant", learners("lattice"))
def test_two_steps_by_hand(variant: str) -> None:
    # Points at 0, 2, 4, scaled to -1, 0, 1; alpha = gamma = lambda = 1/2; two actions.
    #
    # The observations 1, 3, 4 are scaled to -1/2, 1/2, 1:
    #   1: points 0 and 1 at squared distance 1/4 each, p = (1/2, 1/2, 0)
    #   3: points 1 and 2 at squared distance 1/4 each, p = (0, 1/2, 1/2)
    #   4: point 2 at distance 0, w = 1; point 1 at distance 1, w = 1/2; p = (0, 1/3, 2/3)
    #
    # Step 1, from 1 to 3, r = 1. The table is zero, the first action is taken and will be.
    #   delta = 1; e(., 0) = (1/2, 1/2, 0); Q(., 0) = 1/2 * 1 * e = (1/4, 1/4, 0)
    #   e decays by gamma lambda = 1/4 to (1/8, 1/8, 0)
    #
    # Step 2, from 3 to 4, r = -1.
    #   Q(4, 0) = 1/3 * 1/4 = 1/12 > Q(4, 1) = 0, so the first action follows; Q(3, 0) = 1/2 * 1/4 = 1/8
    #   delta = -1 + 1/2 * 1/12 - 1/8 = -13/12
    #   e(., 0) = (1/8, 1/2, 1/2)
    #   Q(., 0) = (1/4, 1/4, 0) - 1/2 * 13/12 * e
    #           = (1/4 - 13/192, 1/4 - 13/48, -13/48) = (35/192, -1/48, -13/48)
    env = ScriptedEnv([[1.0], [3.0], [4.0]], [1.0, -1.0])
    model = make_model(env, variant, **LINE)
    model.learn(2)
    expected = np.array([[35 / 192, 0.0], [-1 / 48, 0.0], [-13 / 48, 0.0]])
    np.testing.assert_allclose(table(model), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("variant", learners("lattice"))
@pytest.mark.parametrize(("end", "last"), [("terminated", -9 / 8), ("truncated", -13 / 12)])
def test_the_end_by_hand(variant: str, end: str, last: float) -> None:
    # The same two steps as an episode. At a termination the target is r alone, delta = -1 - 1/8 = -9/8; at a
    # truncation it is what it was above. The table gets alpha delta e with e = (1/8, 1/2, 1/2).
    #
    # A third step starts again at 1, with r = 1, p = (1/2, 1/2, 0) and no traces left from before:
    #   it leads to 3, where the first action has a negative value, so that the second follows, with value 0
    #   Q(1, 0) = 1/2 (Q(0, 0) + Q(1, 0)); delta = 1 - Q(1, 0); Q(2, 0) stays as it is
    env = ScriptedEnv([[1.0], [3.0], [4.0]], [1.0, -1.0], end=end)
    model = make_model(env, variant, **LINE)
    model.learn(3)
    after_two = np.array([1 / 4, 1 / 4, 0.0]) + 0.5 * last * np.array([1 / 8, 1 / 2, 1 / 2])
    delta = 1.0 - after_two @ [1 / 2, 1 / 2, 0.0]
    expected = after_two + 0.5 * delta * np.array([1 / 2, 1 / 2, 0.0])
    np.testing.assert_allclose(table(model)[:, 0], expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(table(model)[:, 1], 0.0)


@pytest.mark.parametrize("variant", learners("lattice"))
def test_normalized_step_by_hand(variant: str) -> None:
    # From 1, where p = (1/2, 1/2, 0) and the sum of squares is 1/2, to the end with r = 3: alpha = 1/2
    # becomes 1, Q = 1 * 3 * p, and Q(1, 0) = 3/2 is the asked half of the error.
    env = ScriptedEnv([[1.0], [3.0]], [3.0], end="terminated")
    model = make_model(env, variant, step_size="normalized", **LINE)
    model.learn(1)
    np.testing.assert_allclose(table(model)[:, 0], [1.5, 1.5, 0.0], rtol=1e-12)
    np.testing.assert_allclose(model.policy.q_values(np.array([[1.0]])).numpy(), [[1.5, 0.0]], rtol=1e-12)


@pytest.mark.parametrize("variant", learners("lattice"))
def test_two_envs_by_hand(variant: str) -> None:
    # One environment sees 1 and ends with r = 1, the other sees 3 and ends with r = 3; alpha = 1/2. Their
    # traces are (1/2, 1/2, 0) and (0, 1/2, 1/2). The outer points get one error each: 1/2 * 1 * 1/2 and
    # 1/2 * 3 * 1/2. The middle one gets both: alpha * mean error * largest trace = 1/2 * 2 * 1/2.
    makers: list[EnvMaker] = [
        lambda: ScriptedEnv([[1.0], [2.0]], [1.0], end="terminated"),
        lambda: ScriptedEnv([[3.0], [2.0]], [3.0], end="terminated"),
    ]
    model = make_model(DummyVecEnv(makers), variant, **LINE)
    model.learn(2)
    np.testing.assert_allclose(table(model)[:, 0], [0.25, 0.5, 0.75], rtol=1e-12)
    np.testing.assert_array_equal(table(model)[:, 1], 0.0)


# ---------------------------------------------------------------------------------------------- perception


def perceived(model: KNNTD, observations: np.ndarray) -> np.ndarray:
    """(batch, n_points): the probability of every point; the order among the neighbours is not compared."""
    perception = model.policy.perceive(observations)
    indices, p = (np.asarray(part) for part in perception)
    assert indices.shape == p.shape
    assert all(len(set(row)) == len(row) for row in indices.tolist())
    spread = np.zeros((len(observations), model.policy.q_table.shape[0]))
    np.put_along_axis(spread, indices.astype(np.int64), p, axis=1)
    return spread


def expected_perception(perceive: Any, observations: np.ndarray) -> np.ndarray:
    spread = np.zeros((len(observations), perceive.n_points))
    for row, observation in zip(spread, observations, strict=True):
        indices, p = perceive(observation)
        row[indices] = p
    return spread


@pytest.mark.parametrize(("variant", "points"), ON_POINTS)
@pytest.mark.parametrize("n_neighbors", [1, 2, 5, 16, 40])
@pytest.mark.parametrize("n_rows", [1, 24, 200])
def test_same_perception(variant: str, points: str, n_neighbors: int, n_rows: int) -> None:
    # The libraries use other code paths for many rows than for a few.
    arguments: dict[str, Any] = {"points": POINTS[points], "bounds": DRIFT_BOUNDS, "n_neighbors": n_neighbors}
    model = make_model(DriftEnv(), variant, **arguments)
    span = DriftEnv.HIGH - DriftEnv.LOW
    rng = np.random.default_rng(n_rows)
    observations = rng.uniform(DriftEnv.LOW - span, DriftEnv.HIGH + span, (n_rows, 2)).astype(np.float32)
    expected = expected_perception(NearestPoints(**arguments), observations)
    np.testing.assert_allclose(perceived(model, observations), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("variant", variants("lattice"))
@pytest.mark.parametrize("n_neighbors", [1, 2, 3, 4, 5, 7, 9, 13])
@pytest.mark.parametrize("shape", [(5, 3), (9, 5, 3), (17,), (3, 3, 3, 3)])
def test_equal_distances_go_to_the_lower_index(variant: str, n_neighbors: int, shape: tuple[int, ...]) -> None:
    # Spacings of powers of two and observations on quarters of them: every distance is exact, and at points,
    # cell centres and edges many are equal.
    d = len(shape)
    low, high = np.zeros(d), np.array([2.0 * (n - 1) for n in shape])
    arguments: dict[str, Any] = {"points": shape, "bounds": (low, high), "n_neighbors": n_neighbors}
    model = make_model(StillEnv(d), variant, **arguments)
    rng = np.random.default_rng(n_neighbors)
    observations = 0.5 * rng.integers(-4, 2 * high.astype(int) + 5, size=(150, d))
    centres = 2.0 * rng.integers(0, np.array(shape) - 1, size=(50, d)) + 1.0
    observations = np.concatenate([observations, centres, low[None], high[None], (low + high)[None] / 2])
    reference = NearestPoints(**arguments)
    np.testing.assert_allclose(
        perceived(model, observations), expected_perception(reference, observations), rtol=1e-13, atol=1e-15
    )


@pytest.mark.parametrize("variant", variants("scattered"))
@pytest.mark.parametrize("n_neighbors", [1, 3, 8])
def test_equal_distances_among_scattered_points(variant: str, n_neighbors: int) -> None:
    # A shuffled lattice has the same points under other indices, and some of them twice.
    points = 4.0 * (lattice((5, 3)) + 1.0)
    points = np.concatenate([points, points[::3]])[np.random.default_rng(2).permutation(20)]
    arguments: dict[str, Any] = {"points": points, "bounds": (np.zeros(2), np.full(2, 8.0)), "n_neighbors": n_neighbors}
    model = make_model(StillEnv(2), variant, **arguments)
    observations = np.array(list(itertools.product(np.arange(-1.0, 9.5, 0.5), repeat=2)))
    reference = NearestPoints(**arguments)
    np.testing.assert_allclose(
        perceived(model, observations), expected_perception(reference, observations), rtol=1e-13, atol=1e-15
    )


@pytest.mark.parametrize("variant", variants("lattice"))
@pytest.mark.parametrize("shape", [(4, 7), (6, 11, 4), (20, 15)])
@pytest.mark.parametrize("n_neighbors", [1, 4, 9])
def test_no_nearer_point_is_missed(variant: str, shape: tuple[int, ...], n_neighbors: int) -> None:
    # If lattice planes are not exact in binary, rounding may distinguish equal distances, and either
    # choice is correct; the distances themselves must agree.
    d = len(shape)
    low, high = -np.arange(1.0, d + 1), np.arange(0.3, d)
    arguments: dict[str, Any] = {"points": shape, "bounds": (low, high), "n_neighbors": n_neighbors}
    model = make_model(StillEnv(d), variant, **arguments)
    spacing = (high - low) / (np.array(shape) - 1)
    centres = low + spacing * (np.random.default_rng(0).integers(0, np.array(shape) - 1, size=(100, d)) + 0.5)
    reference = NearestPoints(**arguments)
    indices = np.asarray(model.policy.perceive(centres).indices)
    scaled = 2.0 * (centres - low) / (high - low) - 1.0
    for x, row in zip(scaled, indices, strict=True):
        squared = ((x - reference.points) ** 2).sum(axis=1)
        np.testing.assert_allclose(np.sort(squared[row]), np.sort(squared)[:n_neighbors], atol=1e-12)


@pytest.mark.parametrize("variant", variants("lattice"))
def test_points_are_in_observation_units(variant: str) -> None:
    low, high = np.array([-2.0, 10.0]), np.array([4.0, 11.0])
    model = make_model(StillEnv(2), variant, points=(3, 2), bounds=(low, high))
    points = [[-2, 10], [-2, 11], [1, 10], [1, 11], [4, 10], [4, 11]]
    np.testing.assert_allclose(np.asarray(model.policy.points), points, rtol=1e-15)


@pytest.mark.parametrize("variant", variants("discrete"))
def test_finite_spaces_are_their_own_points(variant: str) -> None:
    model = make_model(GridEnv("multi_discrete", shape=(3, 4)), variant)
    observations = np.array(list(itertools.product(range(3), range(4))))
    np.testing.assert_array_equal(perceived(model, observations), np.eye(12))
    np.testing.assert_array_equal(expected_perception(ExactStates((3, 4)), observations), np.eye(12))
    model = make_model(GridEnv("discrete", shape=(3, 4)), variant)
    np.testing.assert_array_equal(perceived(model, np.arange(12)), np.eye(12))


# ---------------------------------------------------------------------------------------------- properties

PROPERTY = settings(max_examples=25, deadline=None, derandomize=True)
SEEDS = st.integers(0, 2**32 - 1)


def random_points(rng: np.random.Generator) -> tuple[int, np.ndarray, int]:
    """Dimensions, scattered points in [-1, 1]^d, and a valid number of neighbours."""
    d = int(rng.integers(1, 5))
    points = rng.uniform(-1.0, 1.0, size=(int(rng.integers(1, 30)), d))
    return d, points, int(rng.integers(1, len(points) + 1))


def still_model(variant: str, d: int, points: Any, n_neighbors: int, **arguments: Any) -> KNNTD:
    bounds = arguments.pop("bounds", (-np.ones(d), np.ones(d)))
    return make_model(
        StillEnv(d), variant, points=points, n_neighbors=n_neighbors, bounds=bounds, gamma=0.9, **arguments
    )


@pytest.mark.parametrize("variant", variants("scattered"))
@pytest.mark.parametrize("weights", ["inverse_quadratic", "gaussian"])
@given(seed=SEEDS, bandwidth=st.floats(0.01, 10.0), reach=st.sampled_from([1.0, 3.0, 100.0]))
@PROPERTY
def test_probabilities(variant: str, weights: str, seed: int, bandwidth: float, reach: float) -> None:
    # Far outside the bounds Gaussian weights underflow; the nearest point must still be the nearest.
    rng = np.random.default_rng(seed)
    d, points, k = random_points(rng)
    model = still_model(variant, d, points, k, weights=weights, bandwidth=bandwidth)
    indices, p = (np.asarray(part) for part in model.policy.perceive(rng.uniform(-reach, reach, size=(7, d))))
    assert indices.shape == p.shape == (7, k)
    assert indices.min() >= 0
    assert indices.max() < len(points)
    assert (p >= 0.0).all()
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)


@pytest.mark.parametrize("variant", variants("scattered"))
@given(seed=SEEDS)
@PROPERTY
def test_the_order_of_points_does_not_matter(variant: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, points, k = random_points(rng)
    order = rng.permutation(len(points))
    observations = rng.uniform(-1.2, 1.2, size=(5, d))
    plain = perceived(still_model(variant, d, points, k), observations)
    shuffled = perceived(still_model(variant, d, points[order], k), observations)
    np.testing.assert_allclose(shuffled, plain[:, order], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("variant", variants("scattered"))
@given(seed=SEEDS)
@PROPERTY
def test_values_lie_between_those_of_the_neighbours(variant: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, points, k = random_points(rng)
    model = still_model(variant, d, points, k)
    values = rng.normal(scale=10.0, size=(len(points), 3))
    set_table(model, values)
    observations = rng.uniform(-1.2, 1.2, size=(5, d))
    q = model.policy.q_values(observations).numpy()
    neighbours = values[np.asarray(model.policy.perceive(observations).indices)]
    assert (q >= neighbours.min(axis=1) - 1e-12).all()
    assert (q <= neighbours.max(axis=1) + 1e-12).all()
    np.testing.assert_allclose(q, perceived(model, observations) @ values, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("variant", variants("scattered"))
@given(seed=SEEDS, constant=st.floats(-1e6, 1e6, allow_subnormal=False))
@PROPERTY
def test_a_constant_table_has_constant_values(variant: str, seed: int, constant: float) -> None:
    rng = np.random.default_rng(seed)
    d, points, k = random_points(rng)
    model = still_model(variant, d, points, k, initial_value=constant)
    q = model.policy.q_values(rng.uniform(-2.0, 2.0, size=(5, d))).numpy()
    np.testing.assert_allclose(q, constant, rtol=1e-12)


@pytest.mark.parametrize(("variant", "kind"), ON_POINTS)
@given(seed=SEEDS)
@PROPERTY
def test_units_do_not_matter(variant: str, kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, points, k = random_points(rng)
    factor, shift = 10.0 ** rng.uniform(-3, 3, size=d), rng.uniform(-5, 5, size=d)
    observations = rng.uniform(-1.2, 1.2, size=(5, d))
    plain: Any = points
    moved: Any = points * factor + shift
    if kind == "lattice":
        plain = moved = tuple(int(n) for n in rng.integers(2, 6, size=d))
        k = min(k, 2**d)
    before = perceived(still_model(variant, d, plain, k), observations)
    bounds = (shift - factor, shift + factor)
    after = perceived(still_model(variant, d, moved, k, bounds=bounds), observations * factor + shift)
    np.testing.assert_allclose(after, before, atol=1e-8)


@pytest.mark.parametrize("variant", learners("scattered"))
@pytest.mark.parametrize("end", ["terminated", "truncated", "never"])
@pytest.mark.parametrize("target", ["sarsa", "q_learning"])
@given(seed=SEEDS, reward=st.floats(-100.0, 100.0, width=32))
@PROPERTY
def test_a_full_step_removes_the_error(variant: str, end: str, target: str, seed: int, reward: float) -> None:
    rng = np.random.default_rng(seed)
    d, points, k = random_points(rng)
    seen = rng.uniform(-1.0, 1.0, size=(2, d))
    model = make_model(
        ScriptedEnv(seen, [reward], end=end, n_actions=3),
        variant,
        points=points,
        n_neighbors=k,
        bounds=(-np.ones(d), np.ones(d)),
        learning_rate=1.0,
        gamma=0.9,
        trace_decay=0.0,
        step_size="normalized",
        target=target,
    )
    set_table(model, rng.normal(size=(len(points), 3)))
    before = model.policy.q_values(seen).numpy()
    model.learn(1)
    after = model.policy.q_values(seen[:1]).numpy()[0]
    action = int(before[0].argmax())
    aim = reward + (0.0 if end == "terminated" else 0.9 * before[1].max())
    np.testing.assert_allclose(after[action], aim, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(np.delete(after, action), np.delete(before[0], action))


def test_toy_episodes_end_as_specified() -> None:
    env: EpisodeEnv = DriftEnv(lengths=(2, 1), ends=("terminated", "truncated", "both"))
    ends = []
    for _ in range(3):
        env.reset()
        ended: tuple[bool, bool] = (False, False)
        while not any(ended):
            _, _, *ended, _ = env.step(0)  # type: ignore[assignment]
        ends.append(tuple(ended))
    assert ends == [(True, False), (False, True), (True, True)]
