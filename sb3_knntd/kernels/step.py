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
def begin(observations, uniforms, rate, eyes, rule, states, memory):
    """
    Perceive and choose where every environment begins an episode.

    :param observations: observation units, shape (n_envs, obs_dim)
    :param uniforms: random numbers in [0, 1), shape (n_envs, n_uniforms)
    :param rate: ε or the temperature
    :param eyes: see :func:`~sb3_knntd.kernels.perceive.perceive`
    :param rule: (target, exploration, random_ties) of :func:`choose`
    :param states: see :func:`learn`; that of the current state is filled
    :param memory: see :func:`learn`
    """
    low, width, limit, search, axes, offsets, columns, weights, bandwidth = eyes
    target, exploration, random_ties = rule
    indices, probabilities, actions = states
    values, _, _, row_slots, initial, _, live, live_slots, _, pace = memory
    means, shares = np.empty(live.shape[1]), np.empty(live.shape[1])
    for env in range(len(observations)):
        here, there = indices[NOW, env], probabilities[NOW, env]
        perceive(observations[env], low, width, limit, search, axes, offsets, columns, weights, bandwidth, here, there)
        add_rows(here, there, values, row_slots, initial, live, live_slots, pace, means)
        actions[NOW, env], _ = choose(means, uniforms[env], rate, target, exploration, random_ties, shares)


@jit
def learn(answers, endings, uniforms, rates, gamma, form, eyes, rule, states, memory, sums):
    """
    Perceive, choose, compute the TD errors and credit them (Algorithm 3), in all environments at once: every
    value is read before any is changed.

    :param answers: (observations, rewards, ended) of the environments, shapes (n_envs, obs_dim) and (n_envs,) twice
    :param endings: (truncated, last observations): whether an episode ended by truncation, shape (n_envs,), and if so
        what was seen last, shape (n_envs, obs_dim)
    :param uniforms: random numbers in [0, 1), shape (n_envs, 2, n_uniforms)
    :param rates: (α, λ, ε or temperature)
    :param gamma: γ
    :param form: (normalized step, accumulating traces, reset other actions), bools
    :param eyes: see :func:`~sb3_knntd.kernels.perceive.perceive`
    :param rule: (target, exploration, random_ties) of :func:`choose`
    :param states: (indices, probabilities, actions), shapes (3, n_envs, k) twice and (3, n_envs): of the state that
        each environment left, ``NOW``, of the one it is in, ``THEN``, and of the ``LAST`` one before a truncation
    :param memory: (values, visited, row_points, row_slots, initial, live_points, live, live_slots, counts, pace), see
        :mod:`sb3_knntd.kernels.memory`
    :param sums: sums of the errors' sizes and of the values, to be added to, shape (2,)
    :return: ``FINE``; or ``NOT_FINITE`` or ``DIVERGED``, and then no value has been changed
    """
    observations, rewards, ended = answers
    truncated, last_observations = endings
    learning_rate, trace_decay, rate = rates
    normalized, accumulating, reset_others = form
    low, width, limit, search, axes, offsets, columns, weights, bandwidth = eyes
    target, exploration, random_ties = rule
    indices, probabilities, actions = states
    values, visited, row_points, row_slots, initial, live_points, live, live_slots, counts, pace = memory
    n_envs, k = indices.shape[1], indices.shape[2]
    n_dims, n_actions = len(low), live.shape[1]
    means, shares = np.empty(n_actions), np.empty(n_actions)
    corrections = np.empty(n_envs)
    places = np.empty((n_envs, k), np.int64)
    size, value_sum = 0.0, 0.0

    for env in range(n_envs):
        if not np.isfinite(rewards[env]):
            return NOT_FINITE
        for j in range(n_dims):
            if not np.isfinite(observations[env, j]):
                return NOT_FINITE
        here, there = indices[THEN, env], probabilities[THEN, env]
        perceive(observations[env], low, width, limit, search, axes, offsets, columns, weights, bandwidth, here, there)
        add_rows(here, there, values, row_slots, initial, live, live_slots, pace, means)
        actions[THEN, env], worth = choose(means, uniforms[env, 0], rate, target, exploration, random_ties, shares)
        if truncated[env]:
            here, there, seen = indices[LAST, env], probabilities[LAST, env], last_observations[env]
            perceive(seen, low, width, limit, search, axes, offsets, columns, weights, bandwidth, here, there)
            add_rows(here, there, values, row_slots, initial, live, live_slots, pace, means)
            _, worth = choose(means, uniforms[env, 1], rate, target, exploration, random_ties, shares)
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
        error = rewards[env] + gamma * worth - value
        corrections[env] = learning_rate * error / squares if normalized else learning_rate * error
        if not np.isfinite(corrections[env]):
            return DIVERGED
        size += abs(error)
        value_sum += value

    for env in range(n_envs):
        action = actions[NOW, env]
        for i in range(k):
            place = places[env, i]
            trace = probabilities[NOW, env, i] / pace[0]
            if accumulating:
                trace += live[place, action, env]
            elif reset_others:
                for other in range(n_actions):
                    if other != action:
                        set_trace(live, place, other, env, 0.0, pace)
            set_trace(live, place, action, env, trace, pace)
    for env in range(n_envs):
        pace[1 + env] += corrections[env] * pace[0]
    pace[0] *= gamma * trace_decay
    for env in range(n_envs):
        if ended[env]:
            end_episode(env, values, row_slots, live_points, live, live_slots, counts, pace)
    if pace[0] < LEAST_CLOCK:
        settle(values, row_slots, live_points, live, live_slots, counts, pace)

    sums[0] += size
    sums[1] += value_sum
    indices[NOW] = indices[THEN]
    probabilities[NOW] = probabilities[THEN]
    actions[NOW] = actions[THEN]
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
