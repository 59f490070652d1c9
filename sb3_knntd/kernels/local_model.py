"""
A model of an environment from nearest transitions: a local linear fit at each point and action.

Each (point, action) has a list of the transitions nearest to it. A new transition is compared with every point once, so
no search tree is needed, and only the fits whose list has changed are made anew. All states are in scaled units. Box
actions are inputs of the fit, in units in which they count as distance; Discrete actions have fits of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import jit

#: How stale the model of a (point, action) is: its fit and its outcome, its outcome only, or nothing.
FIT, OUTCOME, FRESH = 2, 1, 0
#: Transitions of less weight, relative to the nearest one, are left out of a fit.
LEAST_WEIGHT = 1e-4
#: Ridge of the slopes, relative to the total weight times the squared bandwidth.
RIDGE = 1e-4
#: Number of times that a fit is refined, after which a slope that is well determined has a relative bias of RIDGE³.
REFINEMENTS = 2
#: Predictions are limited to the range of the neighbours, widened by this share of it on each side.
EXTRAPOLATION = 0.5


class TransitionArrays(NamedTuple):
    """
    Transitions in a fixed order.

    :param states: shape (capacity, obs_dim), scaled units
    :param next_states: shape (capacity, obs_dim), scaled units
    :param actions: Box actions, shape (capacity, action_dim), units of distance; Discrete: (capacity, 0)
    :param columns: Discrete actions, shape (capacity,), int64; of a Box zeros
    :param rewards: shape (capacity,)
    :param terminated: whether the next state is terminal, shape (capacity,), bool
    """

    states: np.ndarray
    next_states: np.ndarray
    actions: np.ndarray
    columns: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray


class ModelArrays(NamedTuple):
    """
    The model at each point and action.

    :param points: shape (n_rows, obs_dim), scaled units
    :param nearest: the nearest transitions by rising distance, shape (n_rows, n_actions, list_size), int32
    :param distances: their squared distances, same shape
    :param counts: how many they are, shape (n_rows, n_actions), int64
    :param coefficients: of the linear fit from (1, state - point, action - action point) to the change of the state and
        the reward, shape (n_rows, n_actions, 1 + obs_dim + action_dim, obs_dim + 1)
    :param limits: lower and upper limits of predictions, shape (n_rows, n_actions, 2, obs_dim + 1)
    :param ends: probability that the next state is terminal, shape (n_rows, n_actions)
    :param end_rewards: mean reward of those that end, shape (n_rows, n_actions)
    :param errors: root of the mean squared residual of the fit over the dimensions, scaled units, shape (n_rows,
        n_actions)
    :param known: whether the nearest transition is near enough, shape (n_rows, n_actions), bool
    :param stale: ``FIT``, ``OUTCOME`` or ``FRESH``, shape (n_rows, n_actions), uint8
    """

    points: np.ndarray
    nearest: np.ndarray
    distances: np.ndarray
    counts: np.ndarray
    coefficients: np.ndarray
    limits: np.ndarray
    ends: np.ndarray
    end_rewards: np.ndarray
    errors: np.ndarray
    known: np.ndarray
    stale: np.ndarray


class FitConfig(NamedTuple):
    """
    Parameters of the fits.

    :param actions: the action points of a Box, shape (n_actions, action_dim), units of distance; Discrete: shape
        (n_actions, 0)
    :param n_fitted: number of transitions that set the bandwidth of a fit
    :param spacing: h, scaled units
    :param reach: largest distance of the nearest transition at which an action is known, scaled units
    """

    actions: np.ndarray
    n_fitted: int
    spacing: float
    reach: float


@jit
def nearest_point(state, points, n_points):
    """
    :param state: scaled units, shape (obs_dim,)
    :param points: shape (n_rows, obs_dim), scaled units
    :param n_points: number of points, at least 1
    :return: index of the nearest point, and its squared distance
    """
    best, least = 0, np.inf
    for point in range(n_points):
        squared = 0.0
        for j in range(len(state)):
            difference = state[j] - points[point, j]
            squared += difference * difference
        if squared < least:
            best, least = point, squared
    return best, least


@jit
def _insert(transition, squared, nearest, distances, count):
    """Insert a transition into a list by distance, after equal ones; the new length, or -1 if it is too far."""
    size = len(nearest)
    if count == size and squared >= distances[size - 1]:
        return -1
    place = min(count, size - 1)
    while place > 0 and distances[place - 1] > squared:
        distances[place], nearest[place] = distances[place - 1], nearest[place - 1]
        place -= 1
    distances[place], nearest[place] = squared, transition
    return min(count + 1, size)


@jit
def _enter_at(point, transition, data, model, config):
    """Insert a transition into the lists of a point, and note which fits have become stale."""
    action_dim, size = data.actions.shape[1], model.nearest.shape[2]
    first = data.columns[transition] if action_dim == 0 else 0
    last = first + 1 if action_dim == 0 else len(config.actions)
    farthest = 0.0
    for action in range(first, last):
        full = model.counts[point, action] == size
        farthest = max(farthest, model.distances[point, action, size - 1] if full else np.inf)
    squared = 0.0
    for j in range(data.states.shape[1]):
        difference = data.states[transition, j] - model.points[point, j]
        squared += difference * difference
        if squared >= farthest:
            return
    for action in range(first, last):
        total = squared
        for j in range(action_dim):
            difference = data.actions[transition, j] - config.actions[action, j]
            total += difference * difference
        count = _insert(
            transition, total, model.nearest[point, action], model.distances[point, action], model.counts[point, action]
        )
        if count >= 0:
            model.counts[point, action] = count
            model.stale[point, action] = FIT


@jit
def enter(transition, data, model, config, n_points):
    """
    Enter a new transition into the lists of all points that it is near to.

    :param transition: its index
    :param data: see :class:`TransitionArrays`
    :param model: see :class:`ModelArrays`
    :param config: see :class:`FitConfig`
    :param n_points: number of points
    """
    for point in range(n_points):
        _enter_at(point, transition, data, model, config)


@jit
def fill_lists(first_point, n_points, n_transitions, data, model, config):
    """
    Make the lists of points from all transitions. Equal to entering the transitions one after the other.

    :param first_point: the first point
    :param n_points: number of points; those before the first one stay as they are
    :param n_transitions: number of transitions
    :param data: see :class:`TransitionArrays`
    :param model: see :class:`ModelArrays`
    :param config: see :class:`FitConfig`
    """
    for point in range(first_point, n_points):
        model.counts[point] = 0
        model.stale[point] = FIT
        for transition in range(n_transitions):
            _enter_at(point, transition, data, model, config)


@jit
def renumber(numbers, model, n_points):
    """
    Replace the numbers of transitions in the lists, and take those out that were dropped.

    :param numbers: the new number of each transition, -1 if it was dropped, shape (n_before,), int64
    :param model: see :class:`ModelArrays`
    :param n_points: number of points
    """
    for point in range(n_points):
        for action in range(model.stale.shape[1]):
            count = 0
            for i in range(model.counts[point, action]):
                number = numbers[model.nearest[point, action, i]]
                if number < 0:
                    model.stale[point, action] = FIT
                    continue
                model.nearest[point, action, count] = number
                model.distances[point, action, count] = model.distances[point, action, i]
                count += 1
            model.counts[point, action] = count


@jit
def factor(matrix):
    """
    Cholesky's decomposition, in place.

    :param matrix: symmetric and positive definite, shape (n, n); only its lower half is read and written
    """
    n = len(matrix)
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(max(rest, 1e-300)) if i == j else rest / matrix[j, j]


@jit
def solve(factored, right):
    """
    Solve a system of linear equations in place.

    :param factored: its matrix, by :func:`factor`, shape (n, n)
    :param right: right side, and then the solution, shape (n, m)
    """
    n, m = right.shape
    for column in range(m):
        for i in range(n):
            rest = right[i, column]
            for k in range(i):
                rest -= factored[i, k] * right[k, column]
            right[i, column] = rest / factored[i, i]
        for i in range(n - 1, -1, -1):
            rest = right[i, column]
            for k in range(i + 1, n):
                rest -= factored[k, i] * right[k, column]
            right[i, column] = rest / factored[i, i]


@jit
def fit(point, action, data, model, config):
    """
    Fit the model of a point and an action to its list: weighted ridge regression (Atkeson, Moore and Schaal, Locally
    weighted learning for control, 1997).

    The weights are Gaussian. Their bandwidth is half the distance of the ``n_fitted``-th transition, at least a quarter
    of the spacing. Where transitions of an episode's end are among them, the reward is not fitted but averaged, apart
    for those that end and those that do not, since it usually jumps there.

    :param point: the point
    :param action: the action
    :param data: see :class:`TransitionArrays`
    :param model: see :class:`ModelArrays`
    :param config: see :class:`FitConfig`
    """
    obs_dim, action_dim = data.states.shape[1], data.actions.shape[1]
    count = model.counts[point, action]
    nearest, distances = model.nearest[point, action], model.distances[point, action]
    model.known[point, action] = count > 0 and distances[0] <= config.reach**2
    if not model.known[point, action]:
        return
    bandwidth = max(0.5 * np.sqrt(distances[min(config.n_fitted, count) - 1]), 0.25 * config.spacing)
    n_inputs = 1 + obs_dim + action_dim
    inputs, outputs = np.empty(n_inputs), np.empty(obs_dim + 1)
    matrix, right = np.zeros((n_inputs, n_inputs)), np.zeros((n_inputs, obs_dim + 1))
    low, high = np.full(obs_dim + 1, np.inf), np.full(obs_dim + 1, -np.inf)
    total, ended, end_rewards, rewards = 0.0, 0.0, 0.0, 0.0
    inputs[0] = 1.0
    n_used = 0
    while n_used < count:
        transition = nearest[n_used]
        weight = np.exp(-0.5 * (distances[n_used] - distances[0]) / (bandwidth * bandwidth))
        if weight < LEAST_WEIGHT:
            break
        n_used += 1
        for j in range(obs_dim):
            inputs[1 + j] = data.states[transition, j] - model.points[point, j]
            outputs[j] = data.next_states[transition, j] - data.states[transition, j]
        for j in range(action_dim):
            inputs[1 + obs_dim + j] = data.actions[transition, j] - config.actions[action, j]
        outputs[obs_dim] = data.rewards[transition]
        total += weight
        n_outputs = obs_dim + 1
        if data.terminated[transition]:
            ended += weight
            end_rewards += weight * outputs[obs_dim]
            n_outputs = obs_dim
        else:
            rewards += weight * outputs[obs_dim]
        for j in range(n_outputs):
            low[j], high[j] = min(low[j], outputs[j]), max(high[j], outputs[j])
        for i in range(n_inputs):
            for j in range(i + 1):
                matrix[i, j] += weight * inputs[i] * inputs[j]
            for j in range(n_outputs):
                right[i, j] += weight * inputs[i] * outputs[j]
    model.ends[point, action] = ended / total
    model.end_rewards[point, action] = end_rewards / ended if ended > 0.0 else 0.0
    ridge = np.full(n_inputs, RIDGE * total * bandwidth * bandwidth)
    ridge[0] = 1e-9 * total
    for i in range(n_inputs):
        matrix[i, i] += ridge[i]
    factor(matrix)
    solve(matrix, right)
    # Iterated ridge regression: what is well determined loses its bias, what is not stays small.
    added = right.copy()
    for _ in range(REFINEMENTS):
        for i in range(n_inputs):
            for j in range(obs_dim + 1):
                added[i, j] *= ridge[i]
        solve(matrix, added)
        right += added
    if ended > 0.0:
        mean = rewards / (total - ended) if total > ended else 0.0
        right[:, obs_dim] = 0.0
        right[0, obs_dim] = low[obs_dim] = high[obs_dim] = mean
    model.coefficients[point, action] = right
    for j in range(obs_dim + 1):
        margin = EXTRAPOLATION * (high[j] - low[j])
        model.limits[point, action, 0, j] = low[j] - margin
        model.limits[point, action, 1, j] = high[j] + margin
    squares = 0.0
    for k in range(n_used):
        transition = nearest[k]
        weight = np.exp(-0.5 * (distances[k] - distances[0]) / (bandwidth * bandwidth))
        for j in range(obs_dim):
            fitted = right[0, j]
            for i in range(obs_dim):
                fitted += right[1 + i, j] * (data.states[transition, i] - model.points[point, i])
            for i in range(action_dim):
                fitted += right[1 + obs_dim + i, j] * (data.actions[transition, i] - config.actions[action, i])
            residual = data.next_states[transition, j] - data.states[transition, j] - fitted
            squares += weight * residual * residual
    model.errors[point, action] = np.sqrt(squares / (total * obs_dim))


@jit
def fit_stale(data, model, config, n_points):
    """
    Fit where lists have changed. The outcomes there remain stale.

    :param data: see :class:`TransitionArrays`
    :param model: see :class:`ModelArrays`
    :param config: see :class:`FitConfig`
    :param n_points: number of points
    """
    for point in range(n_points):
        for action in range(model.stale.shape[1]):
            if model.stale[point, action] == FIT:
                fit(point, action, data, model, config)
                model.stale[point, action] = OUTCOME


@jit
def predict(state, point, action, offset, model, outputs):
    """
    Predict one step by the fit of a point and an action.

    :param state: scaled units, shape (obs_dim,)
    :param point: the point
    :param action: the action
    :param offset: the action minus the action point, shape (action_dim,), units of distance; empty for the action point
        itself
    :param model: see :class:`ModelArrays`
    :param outputs: output, the change of the state and the reward if the step does not end, shape (obs_dim + 1,)
    """
    obs_dim = len(state)
    coefficients, limits = model.coefficients[point, action], model.limits[point, action]
    for j in range(obs_dim + 1):
        value = coefficients[0, j]
        for i in range(obs_dim):
            value += coefficients[1 + i, j] * (state[i] - model.points[point, i])
        for i in range(len(offset)):
            value += coefficients[1 + obs_dim + i, j] * offset[i]
        outputs[j] = min(max(value, limits[0, j]), limits[1, j])
