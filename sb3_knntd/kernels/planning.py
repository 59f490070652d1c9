"""
Planning on a table: held actions, value iteration, and simulated episodes.

The values at the points are planned in two ways over one model. Value iteration is fast and global, and can give an
optimistic value to what is not known. It averages values where a held action ends, so it is blurred near a cliff.
Simulated episodes correct this: they follow the greedy policy step by step, and TD(λ) learns from them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import jit
from sb3_knntd.kernels.local_model import FRESH, nearest_point, predict

#: A way is not followed further when what comes later counts less than this.
LEAST_DISCOUNT = 1e-3
#: A simulated episode ends when the model says so with at least this probability.
END = 0.5


class OutcomeArrays(NamedTuple):
    """
    What follows on each point and action: a reward, and the points around the place where it leads to.

    :param successors: points, shape (n_rows, n_actions, n_successors), int32
    :param weights: their weights, same shape; they sum to 1 or are all 0
    :param rewards: discounted reward until then, shape (n_rows, n_actions)
    :param discounts: discount of the value there, shape (n_rows, n_actions)
    :param unknown: probability that what follows is not known, shape (n_rows, n_actions)
    :param places: where it leads to, shape (n_rows, n_actions, obs_dim), scaled units
    :param reaches: squared distance of the farthest successor from there, -1 if there is no outcome yet, shape (n_rows,
        n_actions)
    """

    successors: np.ndarray
    weights: np.ndarray
    rewards: np.ndarray
    discounts: np.ndarray
    unknown: np.ndarray
    places: np.ndarray
    reaches: np.ndarray


class PlanConfig(NamedTuple):
    """
    Parameters of planning. Lengths are in scaled units.

    :param gamma: γ
    :param spacing: h
    :param bandwidth: of the Gaussian weights with which the table is read
    :param move: an action is held until the state has moved this far
    :param most_held: or for this number of steps
    :param far: what lies farther than this from all points is not known
    :param low: lower limit of predicted states, shape (obs_dim,)
    :param high: upper limit of predicted states, shape (obs_dim,)
    :param offset: observation units of the scaled state -1, shape (obs_dim,)
    :param unit: observation units of a scaled unit, shape (obs_dim,)
    :param actions: the action of each column: action units, shape (n_actions, action_dim); Discrete: its number counted
        from the start of the space, shape (n_actions, 1)
    """

    gamma: float
    spacing: float
    bandwidth: float
    move: float
    most_held: int
    far: float
    low: np.ndarray
    high: np.ndarray
    offset: np.ndarray
    unit: np.ndarray
    actions: np.ndarray


@jit
def gaussian_neighbors(state, points, n_points, bandwidth, indices, weights):
    """
    Find the nearest points and weigh them.

    :param state: scaled units, shape (obs_dim,)
    :param points: shape (n_rows, obs_dim), scaled units
    :param n_points: number of points, at least 1
    :param bandwidth: of the Gaussian, scaled units
    :param indices: output, the nearest points by rising distance, shape (k,), int64
    :param weights: output, their weights, which sum to 1, shape (k,); 0 where there are fewer points
    :return: squared distances of the nearest and of the farthest of them; the latter is infinite if there are fewer
    """
    k, count = len(indices), 0
    for point in range(n_points):
        squared = 0.0
        for j in range(len(state)):
            difference = state[j] - points[point, j]
            squared += difference * difference
        if count == k and squared >= weights[k - 1]:
            continue
        place = min(count, k - 1)
        while place > 0 and weights[place - 1] > squared:
            weights[place], indices[place] = weights[place - 1], indices[place - 1]
            place -= 1
        weights[place], indices[place] = squared, point
        count = min(count + 1, k)
    nearest, farthest = weights[0], weights[count - 1] if count == k else np.inf
    total = 0.0
    for i in range(count):
        weights[i] = np.exp(-0.5 * (weights[i] - nearest) / (bandwidth * bandwidth))
        total += weights[i]
    for i in range(count):
        weights[i] /= total
    for i in range(count, k):
        indices[i], weights[i] = indices[0], 0.0
    return nearest, farthest


@jit
def _advance(state, point, action, model, config, reward_function, outputs, places):
    """
    Replace a state by the predicted next one, within limits.

    :param places: work space, shape (2, obs_dim)
    :return: reward, and probability that the next state is terminal
    """
    predict(state, point, action, places[0, :0], model, outputs)
    obs_dim = len(state)
    for j in range(obs_dim):
        places[0, j] = config.offset[j] + config.unit[j] * (state[j] + 1.0)
        state[j] = min(max(state[j] + outputs[j], config.low[j]), config.high[j])
        places[1, j] = config.offset[j] + config.unit[j] * (state[j] + 1.0)
    end = model.ends[point, action]
    if reward_function is None:
        reward = (1.0 - end) * outputs[obs_dim] + end * model.end_rewards[point, action]
    else:
        reward = reward_function(places[0], config.actions[action], places[1])
    return reward, end


@jit
def _hold(start, action, n_points, model, config, reward_function, state, outputs, places):
    """
    Hold an action in the model until the state has moved far enough, or its way leaves what is known.

    :return: reward, discount, and whether it is not known how it goes on; ``state`` is where it leads to
    """
    total, discount, moved = 0.0, 1.0, 0.0
    state[:] = start
    for _ in range(config.most_held):
        point, _ = nearest_point(state, model.points, n_points)
        if not model.known[point, action]:
            # After half a spacing it is told what the action does.
            return total, discount, moved < 0.25 * config.spacing**2
        reward, end = _advance(state, point, action, model, config, reward_function, outputs, places)
        total += discount * reward
        discount *= config.gamma * (1.0 - end)
        moved = 0.0
        for j in range(len(state)):
            moved += (state[j] - start[j]) ** 2
        if moved > config.move**2 or discount < LEAST_DISCOUNT:
            break
    return total, discount, False


@jit
def make_outcome(point, action, n_points, model, outcomes, config, reward_function, state, outputs, places):
    """
    Find what follows on a point if an action is held.

    :param point: the point
    :param action: the action
    :param n_points: number of points
    :param model: see :class:`~sb3_knntd.kernels.local_model.ModelArrays`
    :param outcomes: see :class:`OutcomeArrays`
    :param config: see :class:`PlanConfig`
    :param reward_function: compiled, from :func:`~sb3_knntd.model.rewards.compiled_reward`; ``None`` if it is learned
    :param state: work space, shape (obs_dim,)
    :param outputs: work space, shape (obs_dim + 1,)
    :param places: work space, shape (2, obs_dim)
    """
    start = model.points[point]
    reward, discount, unknown = _hold(start, action, n_points, model, config, reward_function, state, outputs, places)
    nearest, farthest = gaussian_neighbors(
        state,
        model.points,
        n_points,
        config.bandwidth,
        outcomes.successors[point, action],
        outcomes.weights[point, action],
    )
    outcomes.rewards[point, action] = reward
    outcomes.discounts[point, action] = discount
    outcomes.unknown[point, action] = 1.0 if unknown or nearest > config.far**2 else 0.0
    outcomes.places[point, action] = state
    outcomes.reaches[point, action] = farthest


@jit
def refresh_outcomes(n_points, n_others, first, model, outcomes, config, reward_function):
    """
    Find the stale outcomes anew, and those of some points in turn, since the ways to them can have changed as well.

    :param n_points: number of points
    :param n_others: number of points whose outcomes are found anew in turn
    :param first: the first of them
    :param model: see :class:`~sb3_knntd.kernels.local_model.ModelArrays`
    :param outcomes: see :class:`OutcomeArrays`
    :param config: see :class:`PlanConfig`
    :param reward_function: compiled, from :func:`~sb3_knntd.model.rewards.compiled_reward`; ``None`` if it is learned
    :return: the point to begin with the next time
    """
    obs_dim = model.points.shape[1]
    state, outputs, places = np.empty(obs_dim), np.empty(obs_dim + 1), np.empty((2, obs_dim))
    n_actions = model.stale.shape[1]
    for point in range(n_points):
        for action in range(n_actions):
            if model.stale[point, action] != FRESH:
                make_outcome(point, action, n_points, model, outcomes, config, reward_function, state, outputs, places)
                model.stale[point, action] = FRESH
    for _ in range(min(n_others, n_points)):
        first = first + 1 if first + 1 < n_points else 0
        for action in range(n_actions):
            make_outcome(first, action, n_points, model, outcomes, config, reward_function, state, outputs, places)
    return first


@jit
def mark_near(point, n_points, model, outcomes, stale):
    """
    Mark the outcomes that a new point is a successor of.

    :param point: the new point
    :param n_points: number of points before it
    :param model: see :class:`~sb3_knntd.kernels.local_model.ModelArrays`
    :param outcomes: see :class:`OutcomeArrays`
    :param stale: the value that marks them
    """
    for other in range(n_points):
        for action in range(model.stale.shape[1]):
            if model.stale[other, action] != FRESH or outcomes.reaches[other, action] < 0.0:
                continue
            squared = 0.0
            for j in range(model.points.shape[1]):
                squared += (outcomes.places[other, action, j] - model.points[point, j]) ** 2
            if squared < outcomes.reaches[other, action]:
                model.stale[other, action] = stale


@jit
def iterate_values(values, best, n_points, known, outcomes, unknown_value, optimistic, tolerance, most_sweeps):
    """
    Value iteration in alternating order. The values are averages, so it converges (Gordon, Stable function
    approximation in dynamic programming, 1995).

    :param values: Q of each point and action, shape (n_rows, n_actions); input and output
    :param best: the values of the best actions, shape (n_rows,); input and output
    :param n_points: number of points
    :param known: whether an action is known at a point, shape (n_rows, n_actions), bool
    :param outcomes: see :class:`OutcomeArrays`
    :param unknown_value: value of what is not known
    :param optimistic: whether what is not known counts as at least that value. Otherwise actions that are not known
        are left out, what follows on a way into the unknown is read from the points nearest to it, and only where
        nothing is known the value is ``unknown_value``
    :param tolerance: largest change of a value in the last sweep
    :param most_sweeps: largest number of sweeps
    :return: number of sweeps
    """
    n_actions, n_successors = outcomes.successors.shape[1:]
    for sweep in range(most_sweeps):
        change = 0.0
        for i in range(n_points):
            point = i if sweep % 2 == 0 else n_points - 1 - i
            highest = -np.inf
            for action in range(n_actions):
                if not known[point, action]:
                    values[point, action] = unknown_value
                    if optimistic:
                        highest = max(highest, unknown_value)
                    continue
                after = 0.0
                for successor in range(n_successors):
                    after += (
                        outcomes.weights[point, action, successor] * best[outcomes.successors[point, action, successor]]
                    )
                if optimistic:
                    after += outcomes.unknown[point, action] * max(unknown_value - after, 0.0)
                value = outcomes.rewards[point, action] + outcomes.discounts[point, action] * after
                values[point, action] = value
                highest = max(highest, value)
            if highest == -np.inf:
                highest = unknown_value
            change = max(change, abs(highest - best[point]))
            best[point] = highest
        if change <= tolerance:
            return sweep + 1
    return most_sweeps


@jit
def uniform(random_state):
    """
    The next number of SplitMix64 (Steele, Lea and Flood, Fast splittable pseudorandom number generators, 2014).

    :param random_state: shape (1,), uint64
    :return: a number in [0, 1)
    """
    random_state[0] += np.uint64(0x9E3779B97F4A7C15)
    bits = random_state[0]
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    bits = bits ^ (bits >> np.uint64(31))
    return (bits >> np.uint64(11)) * (1.0 / 9007199254740992.0)


#: Where a simulated episode leaves what is known, its value is moved by this share towards the lowest one around.
PESSIMISM = 0.3
#: Points of less weight do not count.
LEAST_SHARE = 0.02


@jit
def known_value(values, known, indices, weights, action):
    """
    Read the value of an action from the points at which it is known.

    :param values: shape (n_rows, n_actions)
    :param known: shape (n_rows, n_actions), bool
    :param indices: points, shape (k,)
    :param weights: shape (k,)
    :param action: the action
    :return: their weighted mean; minus infinity if hardly any of them knows it
    """
    total, known_weight = 0.0, 0.0
    for i in range(len(indices)):
        if known[indices[i], action]:
            total += weights[i] * values[indices[i], action]
            known_weight += weights[i]
    return total / known_weight if known_weight > LEAST_SHARE else -np.inf


class SimulationConfig(NamedTuple):
    """
    Parameters of simulated episodes.

    :param n_steps: number of simulated steps
    :param longest: largest number of steps of an episode
    :param from_start: share of the episodes that begin where real ones began, the others at any state in the data
    :param planned: share of the episodes that follow the values of value iteration
    :param epsilon: share of random actions
    :param learning_rate: α, the share of the error that an update removes
    :param trace_decay: λ
    :param lowest: lower limit of values
    :param highest: upper limit of values
    """

    n_steps: int
    longest: int
    from_start: float
    planned: float
    epsilon: float
    learning_rate: float
    trace_decay: float
    lowest: float
    highest: float


@jit
def simulate(
    values,
    planned_values,
    planned_best,
    n_points,
    n_transitions,
    starts,
    data,
    model,
    config,
    simulation,
    reward_function,
    random_state,
    k,
):
    """
    Learn from episodes in the model by the λ-return, after each episode, from its last step to its first.

    The λ-return is not cut at actions that are not greedy (Peng's Q(λ): Peng and Williams, Incremental multi-step
    Q-learning, 1996). An update removes the share α of the error of the mean of the neighbours' values, as with
    ``step_size="normalized"``. An episode ends where it leaves what is known. There its value is moved towards the
    lowest one around: a greedy policy should not lead to where its model has nothing to say.

    :param values: Q of each point and action, shape (n_rows, n_actions); input and output
    :param planned_values: the same from value iteration
    :param planned_best: of ``planned_values``, shape (n_rows,)
    :param n_points: number of points
    :param n_transitions: number of transitions
    :param starts: states that episodes began in, shape (n_starts, obs_dim), scaled units
    :param data: see :class:`~sb3_knntd.kernels.local_model.TransitionArrays`
    :param model: see :class:`~sb3_knntd.kernels.local_model.ModelArrays`
    :param config: see :class:`PlanConfig`
    :param simulation: see :class:`SimulationConfig`
    :param reward_function: compiled, from :func:`~sb3_knntd.model.rewards.compiled_reward`; ``None`` if it is learned
    :param random_state: shape (1,), uint64
    :param k: number of neighbours with which the table is read
    """
    obs_dim, n_actions, longest = model.points.shape[1], values.shape[1], simulation.longest
    indices, weights = np.empty((longest + 1, k), np.int64), np.empty((longest + 1, k))
    actions, rewards, discounts = np.empty(longest, np.int64), np.empty(longest), np.empty(longest)
    state, outputs, places = np.empty(obs_dim), np.empty(obs_dim + 1), np.empty((2, obs_dim))
    known, used = model.known, 0
    while used < simulation.n_steps:
        if uniform(random_state) < simulation.from_start and len(starts):
            state[:] = starts[int(uniform(random_state) * len(starts))]
        else:
            state[:] = data.states[int(uniform(random_state) * n_transitions)]
        follows_plan = uniform(random_state) < simulation.planned
        length, ended, leaves = 0, False, False
        while True:
            nearest, _ = gaussian_neighbors(
                state, model.points, n_points, config.bandwidth, indices[length], weights[length]
            )
            used += 1
            point = indices[length, 0]
            best, highest, n_known = -1, -np.inf, 0
            chosen, planned = -1, -np.inf
            for action in range(n_actions):
                if not known[point, action]:
                    continue
                n_known += 1
                value = known_value(values, known, indices[length], weights[length], action)
                if value > highest or best < 0:
                    best, highest = action, value
                if planned_values[point, action] > planned:
                    chosen, planned = action, planned_values[point, action]
            leaves = n_known == 0 or nearest > config.far**2
            if length == longest or leaves:
                break
            if not follows_plan:
                chosen = best
            if uniform(random_state) < simulation.epsilon:
                place = int(uniform(random_state) * n_known)
                for action in range(n_actions):
                    if known[point, action]:
                        if place == 0:
                            chosen = action
                        place -= 1
            actions[length] = chosen
            rewards[length], end = _advance(state, point, chosen, model, config, reward_function, outputs, places)
            discounts[length] = config.gamma * (1.0 - end)
            length += 1
            if end > END:
                ended = True
                break
        returned = 0.0
        for step in range(length - 1, -1, -1):
            is_last = step == length - 1
            after = 0.0
            if not (is_last and ended):
                after = -np.inf
                for action in range(n_actions):
                    after = max(after, known_value(values, known, indices[step + 1], weights[step + 1], action))
                if after == -np.inf:
                    after = values[indices[step + 1, 0]].max()
                if is_last and leaves:
                    lowest = after
                    for i in range(k):
                        if weights[step + 1, i] > LEAST_SHARE:
                            lowest = min(lowest, planned_best[indices[step + 1, i]])
                    after += PESSIMISM * (lowest - after)
                if not is_last:
                    after += simulation.trace_decay * (returned - after)
            returned = rewards[step] + discounts[step] * after
            action = actions[step]
            total, weight, squares = 0.0, 0.0, 0.0
            for i in range(k):
                if known[indices[step, i], action]:
                    total += weights[step, i] * values[indices[step, i], action]
                    weight += weights[step, i]
                    squares += weights[step, i] ** 2
            change = simulation.learning_rate * (returned - total / weight) * weight / squares
            for i in range(k):
                point = indices[step, i]
                if known[point, action]:
                    value = values[point, action] + change * weights[step, i]
                    values[point, action] = min(max(value, simulation.lowest), simulation.highest)


@jit
def fill_unknown(values, n_points, model, bandwidth, k):
    """
    Give each action that is not known at a point the value that it has at the points around, or, if it is not known
    there either, the lowest of the known ones at the point: a greedy policy then does not try it.

    :param values: Q of each point and action, shape (n_rows, n_actions); input and output
    :param n_points: number of points
    :param model: see :class:`~sb3_knntd.kernels.local_model.ModelArrays`
    :param bandwidth: of the weights with which the table is read, scaled units
    :param k: number of neighbours with which the table is read
    """
    indices, weights = np.empty(k, np.int64), np.empty(k)
    for point in range(n_points):
        if model.known[point].all():
            continue
        gaussian_neighbors(model.points[point], model.points, n_points, bandwidth, indices, weights)
        lowest = np.inf
        for action in range(values.shape[1]):
            if model.known[point, action]:
                lowest = min(lowest, values[point, action])
        for action in range(values.shape[1]):
            if model.known[point, action]:
                continue
            value = known_value(values, model.known, indices, weights, action)
            if value > -np.inf:
                values[point, action] = value
            elif lowest < np.inf:
                values[point, action] = lowest
