"""One step of kNN-TD(λ) in all environments."""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import jit
from sb3_knntd.kernels.memory import (
    LEAST_CLOCK,
    add_rows,
    add_stored_rows,
    end_episode,
    enliven,
    set_trace,
    settle,
    total,
)
from sb3_knntd.kernels.perceive import perceive

SARSA, Q_LEARNING, EXPECTED_SARSA = 0, 1, 2
EPSILON_GREEDY, SOFTMAX = 0, 1

#: Which state's arrays.
NOW, THEN, LAST = 0, 1, 2
#: What :func:`learn` answers: all is well, the environments' numbers are not finite, or the table's are not.
FINE, NOT_FINITE, DIVERGED = 0, 1, 2


@jit
def pick(uniform, n):
    """One of n, by a uniform random number."""
    return min(np.int64(uniform * n), n - 1)


@jit
def best_action(values):
    """The first of the best actions."""
    best = 0
    for action in range(1, len(values)):
        if values[action] > values[best]:
            best = action
    return best


@jit
def greedy_action(values, uniform, random_ties):
    """The best action, drawn from equals or the first of them."""
    best = best_action(values)
    if not random_ties:
        return best
    ties = 0
    for action in range(len(values)):
        ties += values[action] == values[best]
    rank = pick(uniform, ties)
    for action in range(len(values)):
        if values[action] == values[best]:
            if rank == 0:
                return action
            rank -= 1
    return best


@jit
def _softmax(values, temperature, shares):
    largest, total = values[best_action(values)], 0.0
    for action in range(len(values)):
        shares[action] = np.exp((values[action] - largest) / temperature)
        total += shares[action]
    for action in range(len(values)):
        shares[action] /= total


@jit
def choose(values, uniforms, rate, target, exploration, random_ties, shares):
    """
    The action to take, and what the state is worth as a target (eqs. 9 to 12).

    :param values: Q(s, ·), shape (n_actions,)
    :param uniforms: random numbers in [0, 1), shape (n_uniforms,)
    :param rate: ε or the temperature
    :param target: ``SARSA``, ``Q_LEARNING`` or ``EXPECTED_SARSA``
    :param exploration: ``EPSILON_GREEDY`` or ``SOFTMAX``
    :param random_ties: whether equal best actions are drawn from
    :param shares: to be used, shape (n_actions,)
    """
    n_actions = len(values)
    if exploration == EPSILON_GREEDY:
        action = greedy_action(values, uniforms[1], random_ties)
        if uniforms[0] < rate:
            action = pick(uniforms[1], n_actions)
    else:
        _softmax(values, rate, shares)
        together, reached = shares.sum(), 0.0
        action = 0
        for candidate in range(n_actions):
            reached += shares[candidate]
            action = candidate
            if uniforms[0] * together < reached:
                break

    if target == SARSA:
        return action, values[action]
    largest = values[best_action(values)]
    if target == Q_LEARNING:
        return action, largest
    worth = 0.0
    if exploration == EPSILON_GREEDY:
        for candidate in range(n_actions):
            worth += values[candidate]
        return action, (1.0 - rate) * largest + rate * (worth / n_actions)
    for candidate in range(n_actions):
        worth += shares[candidate] * values[candidate]
    return action, worth


@jit
def perceive_and_choose(observation, uniforms, rate, state, env, desk):
    """
    Perceive what an environment shows, and choose; both are noted on the desk.

    :param observation: observation units, shape (obs_dim,)
    :param uniforms: random numbers in [0, 1), shape (n_uniforms,)
    :param rate: ε or the temperature
    :param state: ``NOW``, ``THEN`` or ``LAST``
    :param env: which environment
    :param desk: see :mod:`sb3_knntd.kernels.desk`
    :return: what the state is worth as a target
    """
    indices, probabilities, means = desk.indices[state, env], desk.probabilities[state, env], desk.means[0]
    perceive(
        observation,
        desk.low,
        desk.width,
        desk.limit,
        desk.search,
        desk.axes,
        desk.offsets,
        desk.columns,
        desk.weights,
        desk.bandwidth,
        indices,
        probabilities,
    )
    add_rows(
        indices,
        probabilities,
        desk.values,
        desk.row_slots,
        desk.initial,
        desk.live,
        desk.live_slots,
        desk.pace,
        means,
    )
    action, worth = choose(means, uniforms, rate, desk.target, desk.exploration, desk.random_ties, desk.means[1])
    desk.actions[state, env] = action
    return worth


@jit
def begin(desk, observations, uniforms, rate):
    """
    Perceive and choose where every environment begins an episode.

    :param desk: see :mod:`sb3_knntd.kernels.desk`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param uniforms: random numbers in [0, 1), shape (n_envs, n_uniforms)
    :param rate: ε or the temperature
    """
    for env in range(len(observations)):
        perceive_and_choose(observations[env], uniforms[env], rate, NOW, env, desk)


@jit
def learn(desk, observations, rewards, ended, uniforms, rates):
    """
    Perceive, choose, compute the TD errors and credit them (Algorithm 3), in all environments at once: every
    value is read before any is changed.

    :param desk: see :mod:`sb3_knntd.kernels.desk`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have, shape (n_envs,), bool
    :param uniforms: random numbers in [0, 1), shape (n_envs, 2, n_uniforms)
    :param rates: (α, λ, ε or temperature)
    :return: ``FINE``; or ``NOT_FINITE`` or ``DIVERGED``, and then no value has been changed
    """
    learning_rate, trace_decay, rate = rates
    values, visited, row_points, row_slots = desk.values, desk.visited, desk.row_points, desk.row_slots
    live_points, live, live_slots, counts, pace = (
        desk.live_points,
        desk.live,
        desk.live_slots,
        desk.counts,
        desk.pace,
    )
    indices, probabilities, actions = desk.indices, desk.probabilities, desk.actions
    places, corrections = desk.places, desk.corrections
    n_envs, k, n_actions = indices.shape[1], indices.shape[2], live.shape[1]
    size, value_sum = 0.0, 0.0

    for env in range(n_envs):
        if not np.isfinite(rewards[env]):
            return NOT_FINITE
        for j in range(observations.shape[1]):
            if not np.isfinite(observations[env, j]):
                return NOT_FINITE
        worth = perceive_and_choose(observations[env], uniforms[env, 0], rate, THEN, env, desk)
        if desk.truncated[env]:
            worth = perceive_and_choose(desk.last_observations[env], uniforms[env, 1], rate, LAST, env, desk)
        elif ended[env]:
            worth = 0.0
        value, squares = 0.0, 0.0
        for i in range(k):
            place = enliven(
                indices[NOW, env, i], values, visited, row_points, row_slots, live_points, live, live_slots, counts
            )
            places[env, i] = place
            probability = probabilities[NOW, env, i]
            value += probability * total(live, place, actions[NOW, env], pace)
            squares += probability * probability
        error = rewards[env] + desk.gamma * worth - value
        corrections[env] = learning_rate * error / squares if desk.normalized else learning_rate * error
        if not np.isfinite(corrections[env]):
            return DIVERGED
        size += abs(error)
        value_sum += value

    for env in range(n_envs):
        action = actions[NOW, env]
        for i in range(k):
            place = places[env, i]
            trace = probabilities[NOW, env, i] / pace[0]
            if desk.accumulating:
                trace += live[place, action, env]
            elif desk.reset_others:
                for other in range(n_actions):
                    if other != action:
                        set_trace(live, place, other, env, 0.0, pace)
            set_trace(live, place, action, env, trace, pace)
    for env in range(n_envs):
        pace[1 + env] += corrections[env] * pace[0]
    pace[0] *= desk.gamma * trace_decay
    for env in range(n_envs):
        if ended[env]:
            end_episode(env, values, row_slots, live_points, live, live_slots, counts, pace)
    if pace[0] < LEAST_CLOCK:
        settle(values, row_slots, live_points, live, live_slots, counts, pace)

    desk.sums[0] += size
    desk.sums[1] += value_sum
    for env in range(n_envs):
        actions[NOW, env] = actions[THEN, env]
        for i in range(k):
            indices[NOW, env, i] = indices[THEN, env, i]
            probabilities[NOW, env, i] = probabilities[THEN, env, i]
    return FINE


@jit
def best_actions(observations, eyes, indices, probabilities, values, row_slots, initial, actions):
    """
    The greedy actions of a batch, ties to the first, read from the table alone.

    :param observations: observation units, shape (batch, obs_dim)
    :param eyes: see :func:`~sb3_knntd.kernels.perceive.perceive`
    :param indices: to be used, or with search ``FOUND`` given, shape (batch, k)
    :param probabilities: likewise
    :param values: see :mod:`sb3_knntd.kernels.memory`, and so ``row_slots`` and ``initial``
    :param actions: to be filled, shape (batch,), int64
    """
    low, width, limit, search, axes, offsets, columns, weights, bandwidth = eyes
    means = np.empty(values.shape[1])
    for i in range(len(observations)):
        here, there, seen = indices[i], probabilities[i], observations[i]
        perceive(seen, low, width, limit, search, axes, offsets, columns, weights, bandwidth, here, there)
        add_stored_rows(here, there, values, row_slots, initial, means)
        actions[i] = best_action(means)
