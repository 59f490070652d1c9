"""The model of KNNDyna: equal to plain NumPy, exact for linear systems, and independent of the order of growth."""

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_knntd.kernels import local_model as kernels
from sb3_knntd.model import LocalModel, TransitionBuffer
from sb3_knntd.model.local import ACTION_DISTANCE, LIST_FACTOR, REACH
from sb3_knntd.perception.bounds import Bounds

SPACING = 0.2


def make_model(rng, n=200, obs_dim=2, n_actions=3, action_dim=0, step=None, n_points=12):
    """A model of random transitions, all within [-1, 1], so that scaled units are observation units."""
    buffer = TransitionBuffer(1000, obs_dim, max(action_dim, 1))
    action_points = np.linspace(-1.0, 1.0, n_actions)[:, None] if action_dim else np.empty((n_actions, 0))
    model = LocalModel(buffer, action_points)
    for _ in range(n):
        state = rng.uniform(-1, 1, obs_dim)
        action = rng.uniform(-1, 1, 1) if action_dim else rng.integers(n_actions, size=1).astype(float)
        buffer.add(state, action, *(step or noisy_step)(state, action, rng))
    points = rng.uniform(-1, 1, (n_points, obs_dim))
    model.lay(points, Bounds(-np.ones(obs_dim), np.ones(obs_dim)), SPACING)
    model.fit()
    return model


def noisy_step(state, action, rng):
    after = 0.9 * state + 0.1 * np.sin(3 * state[::-1]) + 0.05 * action[0] + rng.normal(0, 0.01, len(state))
    return float(state.sum() + action[0]), after, bool(after[0] > 0.8)


def plain_fit(model, point, action):
    """Prediction at the point and its probability of an end, by NumPy's least squares."""
    buffer, size = model.buffer, model.buffer.n_transitions
    place = model.arrays.points[point]
    gaps = ((buffer.observations[:size] - place) ** 2).sum(axis=1)
    inputs = [np.ones(size), *(buffer.observations[:size] - place).T]
    if model.action_points.shape[1]:
        offsets = (buffer.actions[:size] - model.action_points[action]) * ACTION_DISTANCE * SPACING
        gaps = gaps + (offsets**2).sum(axis=1)
        inputs += list(offsets.T)
    else:
        gaps = np.where(buffer.actions[:size, 0] == action, gaps, np.inf)
    n_inputs = len(inputs)
    near = np.argsort(gaps, kind="stable")[: LIST_FACTOR * 2 * n_inputs]
    near = near[np.isfinite(gaps[near])]
    if not len(near) or gaps[near[0]] > (REACH * SPACING) ** 2:
        return None
    bandwidth = max(0.5 * np.sqrt(gaps[near[min(2 * n_inputs, len(near)) - 1]]), 0.25 * SPACING)
    weights = np.exp(-0.5 * (gaps[near] - gaps[near[0]]) / bandwidth**2)
    near, weights = near[weights >= kernels.LEAST_WEIGHT], weights[weights >= kernels.LEAST_WEIGHT]
    x = np.stack(inputs, axis=1)[near]
    y = (buffer.next_observations - buffer.observations[: len(buffer.next_observations)])[near]
    ridge = np.full(n_inputs, kernels.RIDGE * weights.sum() * bandwidth**2)
    ridge[0] = 1e-9 * weights.sum()
    normal = x.T @ (weights[:, None] * x)
    # Iterated: each round fits what the last one has left.
    slopes = np.zeros((n_inputs, y.shape[1]))
    for _ in range(1 + kernels.REFINEMENTS):
        slopes += np.linalg.solve(normal + np.diag(ridge), x.T @ (weights[:, None] * (y - x @ slopes)))
    ends = weights @ buffer.terminated[near] / weights.sum()
    margin = kernels.EXTRAPOLATION * (y.max(axis=0) - y.min(axis=0))
    return np.clip(slopes[0], y.min(axis=0) - margin, y.max(axis=0) + margin), ends


@pytest.mark.parametrize("action_dim", [0, 1])
@pytest.mark.parametrize("obs_dim", [1, 2, 4])
def test_fits_equal_those_of_plain_numpy(action_dim, obs_dim):
    model = make_model(np.random.default_rng(obs_dim), obs_dim=obs_dim, action_dim=action_dim)
    n_known = 0
    for point in range(model.n_points):
        for action in range(3):
            expected = plain_fit(model, point, action)
            assert model.known[point, action] == (expected is not None)
            if expected is None:
                continue
            n_known += 1
            outputs = np.empty(obs_dim + 1)
            kernels.predict(model.arrays.points[point], point, action, np.empty(0), model.arrays, outputs)
            np.testing.assert_allclose(outputs[:-1], expected[0], atol=1e-9)
            assert model.arrays.ends[point, action] == pytest.approx(expected[1], abs=1e-12)
    assert n_known > 5


def linear_step(state, action, rng):
    after = np.array([[0.95, 0.08], [-0.1, 0.9]]) @ state + np.array([0.0, 0.05]) * action[0]
    return float(state @ [1.0, -2.0] + 0.5 * action[0]), after, False


def test_the_model_of_a_linear_system_is_exact():
    rng = np.random.default_rng(0)
    model = make_model(rng, n=400, action_dim=1, step=linear_step)
    for _ in range(50):
        state, action = rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.9, 0.9, 1)
        reward, after, _ = linear_step(state, action, rng)
        prediction = model.predict(state, action)
        np.testing.assert_allclose(prediction.observation, after, atol=1e-6)
        assert prediction.reward == pytest.approx(reward, abs=1e-6)
        assert prediction.known
        assert prediction.end == 0.0
        assert (prediction.error < 1e-6).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([0, 1]), st.integers(0, 12))
def test_points_and_transitions_may_come_in_any_order(seed, action_dim, n_later):
    """Lists that were filled while transitions and points came equal those made at once."""
    model = make_model(np.random.default_rng(seed), n=60, action_dim=action_dim)
    buffer, points = model.buffer, model.arrays.points[: model.n_points].copy()
    grown = LocalModel(TransitionBuffer(1000, 2, 1), model.action_points)
    first = len(points) - n_later
    grown.lay(points[:first], Bounds(-np.ones(2), np.ones(2)), SPACING)
    for i in range(60):
        if i == 30:
            grown.add_points(points[first:])
        grown.buffer.add(
            buffer.observations[i],
            buffer.actions[i],
            buffer.rewards[i],
            buffer.next_observations[i],
            bool(buffer.terminated[i]),
        )
        grown.scale(i)
        grown.enter(i)
    grown.fit()
    for name in ("counts", "known", "ends", "coefficients", "limits"):
        expected = getattr(model.arrays, name)[: len(points)]
        if name in ("coefficients", "limits"):
            expected = np.where(model.known[:, :, None, None], expected, 0.0)
        actual = getattr(grown.arrays, name)[: len(points)]
        np.testing.assert_array_equal(actual, expected, err_msg=name)


def test_what_is_far_from_all_steps_is_not_known():
    rng = np.random.default_rng(0)
    model = make_model(rng, n=400, step=lambda state, action, rng: (0.0, state, False))
    model.buffer.observations[:400] *= 0.3
    model.set_scale(Bounds(-np.ones(2), np.ones(2)), 0.1)
    near, far = (model.predict(np.full(2, place), np.zeros(1)) for place in (0.0, 0.9))
    assert near.known
    assert not far.known
    assert far.distance > 5.0 > near.distance


def test_an_action_that_was_never_taken_has_no_prediction():
    model = make_model(np.random.default_rng(0), n=50, step=linear_step)
    model.buffer.actions[:50] = 0.0
    model.scale(0)
    prediction = model.predict(np.zeros(2), np.array([1.0]))
    assert not prediction.known
    assert np.isnan(prediction.observation).all()
    assert np.isnan(prediction.reward)


def test_a_full_buffer_drops_where_transitions_are_dense():
    rng = np.random.default_rng(0)
    buffer = TransitionBuffer(300, 2, 1)
    model = LocalModel(buffer, np.empty((1, 0)))
    # Nine tenths of the transitions are at one place.
    for i in range(300):
        state = rng.uniform(-1, 1, 2) if i % 10 == 0 else rng.normal(0.5, 0.01, 2)
        buffer.add(state, np.zeros(1), 0.0, state, False)
    sparse = buffer.observations[:300:10].copy()
    model.lay(np.concatenate((sparse, [[0.5, 0.5]])), Bounds(-np.ones(2), np.ones(2)), SPACING)
    model.fit()
    lists = [model.data.states[model.arrays.nearest[p, 0, : model.arrays.counts[p, 0]]].copy() for p in range(31)]
    model.make_room()
    assert buffer.n_transitions == 270
    assert {tuple(place) for place in sparse} <= {tuple(place) for place in buffer.observations[:270]}
    kept = {tuple(place) for place in model.data.states[:270]}
    for point, before in enumerate(lists):
        # The lists name the same transitions by their new numbers.
        now = model.data.states[model.arrays.nearest[point, 0, : model.arrays.counts[point, 0]]]
        np.testing.assert_array_equal(now, [place for place in before if tuple(place) in kept])


def test_solve_is_that_of_numpy():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(5, 5))
    matrix = matrix @ matrix.T + np.eye(5)
    right = rng.normal(size=(5, 3))
    expected = np.linalg.solve(matrix, right)
    kernels.factor(matrix)
    kernels.solve(matrix, right)
    np.testing.assert_allclose(right, expected, atol=1e-12)


def test_a_buffer_is_restored():
    model = make_model(np.random.default_rng(0), n=30)
    model.buffer.add_start(np.zeros(2))
    other = TransitionBuffer(1000, 2, 1)
    other.load_state_dict(model.buffer.state_dict())
    assert other.n_transitions == 30
    np.testing.assert_array_equal(other.observations[:30], model.buffer.observations[:30])
    np.testing.assert_array_equal(other.starts, model.buffer.starts)
    with pytest.raises(ValueError, match=r"buffer holds 30 transitions, more than buffer_size=20"):
        TransitionBuffer(20, 2, 1).load_state_dict(model.buffer.state_dict())
    with pytest.raises(ValueError, match=r"actions must have shape"):
        other.load_state_dict({**model.buffer.state_dict(), "actions": th.zeros((3, 3), dtype=th.float64)})
