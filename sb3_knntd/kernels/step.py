"""One step of kNN-TD(λ) in all environments."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from sb3_knntd.kernels.desk import desk_at, place_of
from sb3_knntd.kernels.jit import inlined, jit
from sb3_knntd.kernels.memory import (
    LEAST_CLOCK,
    end_episode,
    enliven,
    find,
    read_live_row,
    read_stored_row,
    set_trace,
    settle,
    total,
)
from sb3_knntd.kernels.perceive import perceive

SARSA, Q_LEARNING, EXPECTED_SARSA = 0, 1, 2
EPSILON_GREEDY, SOFTMAX, PER_NEIGHBOR, SHARED = 0, 1, 2, 3

#: What is made of the neighbours' rows: one action from their average, or an action each, which are averaged.
AVERAGE, EACH = 0, 1
#: No column is being explored, or none has been drawn in this episode.
GREEDY, UNDRAWN = -1, -2

#: Which state's arrays.
NOW, THEN, LAST = 0, 1, 2
#: What :func:`learn` answers: all is well, there are no more random numbers or there is no room for the points that it
#: may come upon, the environments' numbers are not finite, or the table's are not.
FINE, USED_UP, FULL, NOT_FINITE, DIVERGED = 0, 1, 2, 3, 4


@inlined
def pick(uniform, n):
    """One of n, by a uniform random number."""
    return min(np.int64(uniform * n), n - 1)


@jit
def best_action(values, first, end):
    """The first of the best actions from ``first`` to before ``end``."""
    best = first
    for action in range(first + 1, end):
        if values[action] > values[best]:
            best = action
    return best


@inlined
def largest(values, first, end):
    """The largest value from ``first`` to before ``end``."""
    value = values[first]
    for action in range(first + 1, end):
        if values[action] > value:
            value = values[action]
    return value


@inlined
def greedy_action(values, first, end, uniform, random_ties):
    """The best action from ``first`` to before ``end``, drawn from equals or the first of them."""
    value = largest(values, first, end)
    best, ties = first, 0
    for action in range(end - 1, first - 1, -1):
        if values[action] == value:
            best = action
            ties += 1
    if ties == 1 or not random_ties:
        return best
    rank = pick(uniform, ties)
    for action in range(best, end):
        if values[action] == value:
            if rank == 0:
                return action
            rank -= 1
    return best


@jit
def _softmax(values, temperature, shares):
    best, total = largest(values, 0, len(values)), 0.0
    for action in range(len(values)):
        shares[action] = np.exp((values[action] - best) / temperature)
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
        action = greedy_action(values, 0, n_actions, uniforms[1], random_ties)
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
    best = largest(values, 0, n_actions)
    if target == Q_LEARNING:
        return action, best
    worth = 0.0
    if exploration == EPSILON_GREEDY:
        for candidate in range(n_actions):
            worth += values[candidate]
        return action, (1.0 - rate) * best + rate * (worth / n_actions)
    for candidate in range(n_actions):
        worth += shares[candidate] * values[candidate]
    return action, worth


@jit
def choose_average(uniforms, rate, state, env, desk):
    """One action from the average of the neighbours' rows. The arguments are those of :func:`perceive_and_choose`."""
    indices, probabilities, entries = desk.indices[state, env], desk.probabilities[state, env], desk.entries[state, env]
    means, row = desk.means[0], desk.means[1]
    # Taken off the desk once: numba counts references to an array each time it is.
    values, row_slots, live, live_slots, pace = desk.values, desk.row_slots, desk.live, desk.live_slots, desk.pace
    means[:] = 0.0
    for i in range(len(indices)):
        place = find(indices[i], live_slots)
        if place >= 0:
            read_live_row(live, place, pace, row)
        else:
            read_stored_row(indices[i], values, row_slots, desk.initial, row)
        for action in range(len(means)):
            means[action] += probabilities[i] * row[action]
    action, worth = choose(means, uniforms, rate, desk.target, desk.exploration, desk.random_ties, row)
    for i in range(len(indices)):
        entries[i, 0] = action
    return worth


@jit
def count_steps(lengths, ended):
    """
    Keep account of how long episodes are.

    :param lengths: the mean length of the episodes so far, the last counting a fifth (0 if none has ended), and the
        number of steps in each environment's own, shape (1 + n_envs,)
    :param ended: whether the step that was just made has ended it, shape (n_envs,), bool
    """
    for env in range(len(ended)):
        lengths[1 + env] += 1.0
        if ended[env]:
            lengths[0] += (1.0 if lengths[0] == 0.0 else 0.2) * (lengths[1 + env] - lengths[0])
            lengths[1 + env] = 0.0


@jit
def hold(uniforms, rate, env, desk):
    """
    Go on with what is being explored, or draw anew whether to explore and what. In the mean the draw is held for
    ``desk.least_hold`` steps, or longer: for ``desk.hold_share`` of an episode, taken to be as long as they are in the
    mean or as this one is already.

    :param uniforms: random numbers in [0, 1), of which the first 2 + n_blocks are used
    :param rate: ε, the share of draws that explore
    :param env: which environment
    :param desk: see :mod:`sb3_knntd.kernels.desk`
    """
    held, lengths = desk.held[env], desk.lengths
    steps = max(desk.least_hold, desk.hold_share * max(lengths[0], lengths[1 + env]))
    if held[0] == UNDRAWN or uniforms[0] * steps < 1.0:
        for block in range(len(held)):
            first, end = desk.blocks[block], desk.blocks[block + 1]
            held[block] = first + pick(uniforms[2 + block], end - first) if uniforms[1] < rate else GREEDY


@jit
def choose_each(uniforms, rate, state, env, desk):
    """
    An action from each neighbour's row, and their average (eqs. 19 to 21, 25 and 27). The arguments are those of
    :func:`perceive_and_choose`.
    """
    indices, probabilities, entries = desk.indices[state, env], desk.probabilities[state, env], desk.entries[state, env]
    held, blocks, row, actions = desk.held[env], desk.blocks, desk.means[0], desk.actions[state, env]
    values, row_slots, live, live_slots, pace = desk.values, desk.row_slots, desk.live, desk.live_slots, desk.pace
    action_points = desk.action_points
    k, n_blocks = entries.shape
    actions[:] = 0.0
    worth = 0.0
    for i in range(k):
        place = find(indices[i], live_slots)
        if place >= 0:
            read_live_row(live, place, pace, row)
        else:
            read_stored_row(indices[i], values, row_slots, desk.initial, row)
        for block in range(n_blocks):
            first, end = blocks[block], blocks[block + 1]
            uniform = uniforms[2 + n_blocks + i * n_blocks + block]
            entry = greedy_action(row, first, end, uniform, desk.random_ties)
            worth += probabilities[i] * row[entry]
            if desk.exploration == SHARED:
                if held[block] >= 0:
                    entry = held[block]
            elif uniforms[2 + n_blocks + (k + i) * n_blocks + block] < rate:
                entry = first + pick(uniform, end - first)
            entries[i, block] = entry
            for j in range(len(actions)):
                actions[j] += probabilities[i] * action_points[entry, j]
    return worth / n_blocks


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
        desk.indices[state, env],
        desk.probabilities[state, env],
    )
    if desk.rule == AVERAGE:
        return choose_average(uniforms, rate, state, env, desk)
    # What would have been done after a truncation is done by nobody, and holds nothing up.
    if desk.exploration == SHARED and state != LAST:
        hold(uniforms, rate, env, desk)
    return choose_each(uniforms, rate, state, env, desk)


@jit
def begin(desk, observations, uniforms, rate):
    """
    Perceive and choose where every environment begins an episode.

    :param desk: see :mod:`sb3_knntd.kernels.desk`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param uniforms: random numbers in [0, 1), shape (n_envs, n_uniforms)
    :param rate: ε or the temperature
    """
    desk.lengths[1:] = 0.0
    for env in range(len(observations)):
        desk.held[env, :] = UNDRAWN
        perceive_and_choose(observations[env], uniforms[env], rate, NOW, env, desk)


@jit
def learn(desk, observations, rewards, ended, learning_rate, trace_decay, rate):
    """
    Perceive, choose, compute the TD errors and credit them (Algorithm 3), in all environments at once: every
    value is read before any is changed.

    :param desk: see :mod:`sb3_knntd.kernels.desk`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have, shape (n_envs,), bool
    :param learning_rate: α
    :param trace_decay: λ
    :param rate: ε or the temperature
    :return: ``FINE``; or ``USED_UP`` or ``FULL``, and then nothing has been done; or ``NOT_FINITE`` or ``DIVERGED``,
        and then no value has been changed
    """
    values, visited, row_points, row_slots = desk.values, desk.visited, desk.row_points, desk.row_slots
    live_points, live, live_slots, counts, pace = (
        desk.live_points,
        desk.live,
        desk.live_slots,
        desk.counts,
        desk.pace,
    )
    indices, probabilities, entries, actions = desk.indices, desk.probabilities, desk.entries, desk.actions
    places, corrections, blocks, row = desk.places, desk.corrections, desk.blocks, desk.means[0]
    _, n_envs, k, n_blocks = entries.shape
    size, value_sum = 0.0, 0.0

    if desk.taken[0] == len(desk.uniforms):
        return USED_UP
    most = n_envs * k
    if len(live_points) - counts[1] < most or (len(row_slots) > 0 and len(values) - counts[0] < most):
        return FULL
    uniforms = desk.uniforms[desk.taken[0]]
    desk.taken[0] += 1
    count_steps(desk.lengths, ended)
    for env in range(n_envs):
        if not np.isfinite(rewards[env]):
            return NOT_FINITE
        for j in range(observations.shape[1]):
            if not np.isfinite(observations[env, j]):
                return NOT_FINITE
        if ended[env]:
            desk.held[env, :] = UNDRAWN
        worth = perceive_and_choose(observations[env], uniforms[env, 0], rate, THEN, env, desk)
        if desk.truncated[env]:
            worth = perceive_and_choose(desk.last_observations[env], uniforms[env, 1], rate, LAST, env, desk)
        elif ended[env]:
            worth = 0.0
        value, squares = 0.0, 0.0
        for i in range(k):
            point = indices[NOW, env, i]
            place = find(point, live_slots)
            if place < 0:
                place = enliven(point, values, visited, row_points, row_slots, live_points, live, live_slots, counts)
            places[env, i] = place
            probability = probabilities[NOW, env, i]
            if desk.rule == AVERAGE:
                value += probability * total(live, place, entries[NOW, env, i, 0], pace)
            else:
                read_live_row(live, place, pace, row)
                for block in range(n_blocks):
                    value += probability * largest(row, blocks[block], blocks[block + 1]) / n_blocks
            squares += probability * probability
        error = rewards[env] + desk.gamma * worth - value
        corrections[env] = learning_rate * error / squares if desk.normalized else learning_rate * error
        if not np.isfinite(corrections[env]):
            return DIVERGED
        size += abs(error)
        value_sum += value

    for env in range(n_envs):
        for i in range(k):
            place, trace = places[env, i], probabilities[NOW, env, i] / pace[0]
            for block in range(n_blocks):
                entry = entries[NOW, env, i, block]
                if desk.accumulating:
                    set_trace(live, place, entry, env, live[place, entry, env] + trace, pace)
                    continue
                if desk.reset_others:
                    for other in range(blocks[block], blocks[block + 1]):
                        if other != entry:
                            set_trace(live, place, other, env, 0.0, pace)
                set_trace(live, place, entry, env, trace, pace)
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
    desk.sums[2] += n_envs
    for env in range(n_envs):
        for j in range(actions.shape[2]):
            actions[NOW, env, j] = actions[THEN, env, j]
        for i in range(k):
            indices[NOW, env, i] = indices[THEN, env, i]
            probabilities[NOW, env, i] = probabilities[THEN, env, i]
            for block in range(n_blocks):
                entries[NOW, env, i, block] = entries[THEN, env, i, block]
    return FINE


@cache
def _learn_at(kind):
    @jit
    def learn_at(address, observations, rewards, ended, learning_rate, trace_decay, rate):
        return learn(desk_at(address, kind), observations, rewards, ended, learning_rate, trace_decay, rate)

    return learn_at


def learn_on(desk):
    """
    :param desk: see :mod:`sb3_knntd.kernels.desk`; to be kept for as long as the function is
    :return: :func:`learn` for this desk, a function of its other arguments
    """
    address, kind = place_of(desk)
    return partial(_learn_at(kind), address)


@jit
def best_entries(observations, eyes, indices, probabilities, values, row_slots, initial, blocks, average, entries):
    """
    The columns that the neighbours of a batch recommend, ties to the first, read from the table alone.

    :param observations: observation units, shape (batch, obs_dim)
    :param eyes: see :func:`~sb3_knntd.kernels.perceive.perceive`
    :param indices: to be filled, or with search ``FOUND`` given, shape (batch, k)
    :param probabilities: likewise
    :param values: see :mod:`sb3_knntd.kernels.memory`, and so ``row_slots`` and ``initial``
    :param blocks: see :mod:`sb3_knntd.kernels.desk`
    :param average: whether all recommend what is best by the average of their rows
    :param entries: to be filled, shape (batch, k, n_blocks), int64
    """
    low, width, limit, search, axes, offsets, columns, weights, bandwidth = eyes
    means, row = np.empty(values.shape[1]), np.empty(values.shape[1])
    _, k, n_blocks = entries.shape
    for case in range(len(observations)):
        here, there, seen = indices[case], probabilities[case], observations[case]
        perceive(seen, low, width, limit, search, axes, offsets, columns, weights, bandwidth, here, there)
        means[:] = 0.0
        for i in range(k):
            read_stored_row(here[i], values, row_slots, initial, row)
            for block in range(n_blocks):
                entries[case, i, block] = best_action(row, blocks[block], blocks[block + 1])
            for action in range(len(means)):
                means[action] += there[i] * row[action]
        if average:
            entries[case, :, 0] = best_action(means, 0, len(means))
