"""Learning from given transitions: the compiled update against plain NumPy and the torch reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from recorded_runs import LENGTHS, RationalEnv, make_venv

from sb3_knntd import KNNTD, ExA
from sb3_knntd.learners import Transitions

Model = KNNTD | ExA


def make(algorithm: type[Model] = KNNTD, compiled: bool = True, n_actions: int = 3, **arguments: Any) -> Model:
    kwargs = {"compiled": compiled, **arguments.pop("policy_kwargs", {})}
    settings = {"points": 6, "n_neighbors": 4, "gamma": 0.9, "seed": 0, **arguments}
    return algorithm(make_venv(n_actions=n_actions, **LENGTHS), policy_kwargs=kwargs, **settings)


def record(n: int, n_actions: int = 3, action_dim: int = 1) -> Transitions:
    """Steps of a random policy, in episodes of several lengths that end both ways."""
    env, random = RationalEnv(n_actions=n_actions, action_dim=action_dim, **LENGTHS), np.random.default_rng(0)
    rows: list[list[Any]] = []
    observation, _ = env.reset()
    for _ in range(n):
        action = int(random.integers(n_actions)) if n_actions else random.uniform(-1.0, 1.0, action_dim)
        after, reward, terminated, truncated, _ = env.step(action)
        rows.append([observation, action, reward, after, terminated, terminated or truncated])
        observation = env.reset()[0] if terminated or truncated else after
    return Transitions(*map(np.array, zip(*rows, strict=True)))


def watkins(model: Model, transitions: Transitions, alpha: float, trace_decay: float) -> np.ndarray:
    """Watkins's Q(λ) with replacing traces over the neighbours, in plain NumPy, shape (n_points, n_actions)."""
    table = model.policy.q_table.numpy().copy()
    traces, goes_on = np.zeros_like(table), False
    columns = model.policy.columns_of(transitions.actions)[:, 0]
    each = isinstance(model, ExA)

    def mean(shares: np.ndarray, values: np.ndarray) -> float:
        # A dot product would round strided values in another order.
        return float((shares * values).sum())

    def perceive(observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        perception = model.policy.perceive(observation)
        return perception.indices[0].numpy(), perception.probabilities[0].numpy()

    def best(indices: np.ndarray, shares: np.ndarray) -> float:
        rows = table[indices]
        return mean(shares, rows.max(axis=1)) if each else float((shares @ rows).max())

    for t in range(len(columns)):
        indices, shares = perceive(transitions.observations[t])
        rows = table[indices]
        given = mean(shares, rows[:, columns[t]]) if each else float((shares @ rows)[columns[t]])
        if goes_on and given < best(indices, shares):
            traces[:] = 0.0
        value = best(indices, shares) if each else given
        target = 0.0 if transitions.terminated[t] else best(*perceive(transitions.next_observations[t]))
        error = transitions.rewards[t] + model.gamma * target - value
        traces[indices, columns[t]] = shares
        table += alpha * error / (shares**2).sum() * traces
        traces *= model.gamma * trace_decay
        goes_on = not transitions.ended[t]
        if not goes_on:
            traces[:] = 0.0
    return table


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("trace_decay", [0.0, 0.8])
@pytest.mark.parametrize(("algorithm", "n_actions"), [(KNNTD, 3), (ExA, 0)])
def test_update_is_watkins_q(algorithm: type[Model], n_actions: int, trace_decay: float, compiled: bool) -> None:
    model, transitions = make(algorithm, compiled, n_actions), record(200, n_actions)
    for _ in range(3):
        expected = watkins(model, transitions, 0.2, trace_decay)
        model.learner.update(transitions, 0.2, trace_decay)
        np.testing.assert_allclose(model.policy.q_table.numpy(), expected, rtol=1e-9, atol=1e-12)
    assert np.unique(expected).size > 20


@pytest.mark.parametrize(
    "arguments",
    [{"points": 300, "policy_kwargs": {"table": "hashed"}}, {"search": "kd_tree"}, {"search": "brute"}],
    ids=str,
)
def test_every_table_and_search(arguments: dict[str, Any]) -> None:
    model, transitions = make(**arguments), record(3000)
    plain = make(**{**arguments, "search": "auto", "policy_kwargs": {"table": "dense"}})
    for each in (model, plain):
        each.learner.update(transitions, 0.2, 0.9)
    observations = transitions.observations[::7]
    assert th.equal(model.policy.q_values(observations), plain.policy.q_values(observations))
    assert model.policy.table.n_visited == plain.policy.table.n_visited


def test_single_steps_in_any_order_are_one_step_q_learning() -> None:
    transitions = record(100)
    order = np.random.default_rng(1).permutation(100)
    shuffled = Transitions(*(array[order] for array in transitions))._replace(ended=np.ones(100, bool))
    model = make()
    expected = watkins(model, shuffled, 0.3, 0.9)
    model.learner.update(shuffled, 0.3, 0.9)
    np.testing.assert_allclose(model.policy.q_table.numpy(), expected, rtol=1e-9, atol=1e-12)


def test_episodes_that_go_on_keep_their_traces() -> None:
    """An update that changes nothing, in the middle of an episode, changes nothing."""
    alone, updated = make(trace_decay=0.95).learn(37), make(trace_decay=0.95).learn(37)
    assert updated.learner.n_traced > 0
    updated.learner.update(record(50), 0.0, 0.9)
    assert updated.learner.n_traced == alone.learner.n_traced
    for model in (alone, updated):
        model.learn(40, reset_num_timesteps=False)
    np.testing.assert_allclose(alone.policy.q_table.numpy(), updated.policy.q_table.numpy(), rtol=1e-12, atol=1e-12)


def test_what_does_not_fit_is_named_and_teaches_nothing() -> None:
    model, transitions = make().learn(50), record(20)
    before = model.policy.q_table.clone()
    wrong = {
        "observations": transitions.observations[:, :1],
        "next_observations": np.full_like(transitions.next_observations, np.nan),
        "actions": transitions.actions + 7,
        "terminated": transitions.terminated[:3],
    }
    for name, array in wrong.items():
        with pytest.raises(ValueError, match=name):
            model.learner.update(transitions._replace(**{name: array}), 0.1, 0.9)
    with pytest.raises(ValueError, match="trace_decay"):
        model.learner.update(transitions, 0.1, 1.5)
    with pytest.raises(FloatingPointError, match="diverge"):
        model.learner.update(transitions, 1e200, 0.9)
    assert th.equal(model.policy.q_table, before)


@pytest.mark.parametrize("compiled", [True, False])
def test_points_that_are_added_between_updates(compiled: bool) -> None:
    """They begin with the values that the table had there, are learned at, and are saved with the model."""
    random, transitions = np.random.default_rng(0), record(300)
    first, later = random.uniform(-1.0, 1.0, (2, 40, 2)) * [2.0, 0.5]
    model = make(points=first, compiled=compiled)
    model.learner.update(transitions, 0.2, 0.9)
    values = model.policy.q_values(later)
    model.policy.add_points(later)
    assert model.policy.q_table.shape == (80, 3)
    assert th.equal(model.policy.q_table[40:], values)
    model.learner.update(transitions, 0.2, 0.9)
    model.learn(300)
    assert not th.equal(model.policy.q_table[40:], values)


def test_added_points_are_saved(tmp_path: Any) -> None:
    random = np.random.default_rng(0)
    first, later = random.uniform(-1.0, 1.0, (2, 40, 2)) * [2.0, 0.5]
    model = make(points=first).learn(100)
    model.policy.add_points(later)
    model.learn(100)
    model.save(tmp_path / "model")
    loaded = KNNTD.load(tmp_path / "model", env=make_venv(**LENGTHS))
    assert th.equal(loaded.policy.points, model.policy.points)
    assert th.equal(loaded.policy.q_table, model.policy.q_table)
    loaded.learn(100)


def test_points_cannot_be_added_to_a_lattice() -> None:
    with pytest.raises(ValueError, match="lattice"):
        make().policy.add_points(np.zeros((1, 2)))
