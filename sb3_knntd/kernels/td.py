"""One step of kNN-TD(λ) in all environments."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from sb3_knntd.kernels.experience import record_steps
from sb3_knntd.kernels.jit import inlined, jit
from sb3_knntd.kernels.perceive import SearchKind, perceive
from sb3_knntd.kernels.selection import (
    UNDRAWN,
    Combination,
    Exploration,
    apply_rules,
    count_steps,
    greedy_and_given_value,
    largest,
    mask,
    persist,
    select,
)
from sb3_knntd.kernels.state import address_of, state_at
from sb3_knntd.kernels.traces import (
    LARGEST_VALUE,
    LEAST_CLOCK,
    activate,
    active_value,
    count_visit,
    end_episode,
    find,
    flush,
    largest_size,
    read_active_row,
    read_stored_row,
    set_trace,
    stored_value,
)

#: Indices of states in the arrays: before the step, after it, and the last one before a truncation.
CURRENT, NEXT, TERMINAL = 0, 1, 2


#: Outcomes of a step: success; more random numbers, more capacity or more points are needed; a rate is out of range, an
#: observation or reward is not finite, or values would become too large. Plain integers: returning a member of an
#: enumeration takes half a microsecond.
OK, NEED_RANDOM, NEED_CAPACITY, NEED_POINTS, BAD_RATE, NOT_FINITE, DIVERGED = range(7)


@jit
def perceive_into(state, observation, which, env):
    """
    Perceive an observation. The neighbours, their probabilities and the forbidden actions are stored in the state.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observation: observation units, shape (obs_dim,)
    :param which: ``CURRENT``, ``NEXT`` or ``TERMINAL``
    :param env: index of the environment
    :return: whether it has to become a point
    """
    indices, probabilities = state.indices[which, env], state.probabilities[which, env]
    if state.n_rules > 0:
        apply_rules(observation, state, state.forbidden[which, env])
    return perceive(observation, state, indices, probabilities) > state.squared_spacing


@jit
def select_at(state, uniforms, rate, which, env):
    """
    Select an action at a perceived observation. It is stored in the state.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param uniforms: random numbers in [0, 1), shape (n_uniforms,)
    :param rate: ε or the temperature
    :param which: ``CURRENT``, ``NEXT`` or ``TERMINAL``
    :param env: index of the environment
    :return: the value of the state as a target
    """
    indices, probabilities = state.indices[which, env], state.probabilities[which, env]
    persistent, forbidden = state.persistent[env], state.forbidden[which, env]
    # The action at a truncated state is never executed; leave the persistent action unchanged.
    if state.exploration == Exploration.SHARED and which != TERMINAL:
        persist(uniforms, rate, state.lengths, env, state, persistent)
    action_indices, mean_action = state.action_indices[which, env], state.actions[which, env]
    return select(indices, probabilities, uniforms, rate, persistent, state, forbidden, action_indices, mean_action)


@jit
def begin(state, observations, uniforms, rate):
    """
    Perceive and select in the first state of an episode in every environment.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param uniforms: random numbers in [0, 1), shape (n_envs, n_uniforms)
    :param rate: ε or the temperature
    """
    state.lengths[1:] = 0.0
    for env in range(len(observations)):
        state.persistent[env, :] = UNDRAWN
        state.current_observations[env] = observations[env]
        perceive_into(state, observations[env], CURRENT, env)
        select_at(state, uniforms[env], rate, CURRENT, env)


@inlined
def _stay_small(change, trace_decay, state):
    """
    Whether all values stay within ``LARGEST_VALUE`` if each entry changes by at most ``change`` times its trace. All
    entries are read only in the rare case that their known bound is not sufficient.
    """
    trace_bound = state.trace_bound[0] + 1.0 if state.accumulating else 1.0
    bound = state.value_bound[0] + change * trace_bound
    if not bound <= LARGEST_VALUE:
        bound = largest_size(state, state) + change * trace_bound
        if not bound <= LARGEST_VALUE:
            return False
    state.value_bound[0] = bound
    state.trace_bound[0] = trace_bound * state.gamma * trace_decay
    return True


@inlined
def update_table(state, target_values, rewards, ended, learning_rate, trace_decay):
    """
    Compute the TD errors of the steps from the ``CURRENT`` states, and update the table along the traces (Algorithm 3).
    The update is synchronous: the values of all environments are read before any is changed.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param target_values: values of the next states, 0 where an episode was terminated, shape (n_envs,)
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have ended, shape (n_envs,), bool
    :param learning_rate: α
    :param trace_decay: λ
    :return: ``OK``, or ``DIVERGED``, in which case no value has been changed
    """
    indices, probabilities = state.indices[CURRENT], state.probabilities[CURRENT]
    chosen = state.action_indices[CURRENT]
    places, corrections, row, factors = state.places, state.corrections, state.row, state.factors
    entries, slots, clock = state.active_entries, state.active_slots, state.clock
    values, row_slots, initial_value = state.values, state.row_slots, state.initial_value
    n_envs, k, n_factors = chosen.shape
    size, value_sum, change = 0.0, 0.0, 0.0
    for env in range(n_envs):
        value, squares = 0.0, 0.0
        for i in range(k):
            place, probability = find(indices[env, i], slots), probabilities[env, i]
            places[env, i] = place
            if state.combination == Combination.OF_VALUES:
                column = chosen[env, i, 0]
                if place >= 0:
                    value += probability * active_value(entries, place, column, clock)
                else:
                    value += probability * stored_value(indices[env, i], column, values, row_slots, initial_value)
            else:
                if place >= 0:
                    read_active_row(entries, place, clock, row)
                else:
                    read_stored_row(indices[env, i], values, row_slots, initial_value, row)
                if state.n_rules > 0:
                    mask(row, state.forbidden[CURRENT, env])
                for factor in range(n_factors):
                    value += probability * largest(row, factors[factor], factors[factor + 1]) / n_factors
            squares += probability * probability
        error = rewards[env] + state.gamma * target_values[env] - value
        corrections[env] = learning_rate * error / squares if state.normalized else learning_rate * error
        if not np.isfinite(corrections[env]):
            return DIVERGED
        size += abs(error)
        change += abs(corrections[env])
        value_sum += value
    if not _stay_small(change, trace_decay, state):
        return DIVERGED

    for env in range(n_envs):
        for i in range(k):
            place, trace = places[env, i], probabilities[env, i] / clock[0]
            if place < 0:
                # Another environment may have activated it in this loop.
                place = find(indices[env, i], slots)
                if place < 0:
                    place = activate(indices[env, i], state, state)
            count_visit(indices[env, i], state.visits, row_slots)
            for factor in range(n_factors):
                entry = chosen[env, i, factor]
                if state.accumulating:
                    set_trace(entries, place, entry, env, entries[place, entry, env] + trace, clock)
                    continue
                if state.reset_other_actions:
                    for other in range(factors[factor], factors[factor + 1]):
                        if other != entry:
                            set_trace(entries, place, other, env, 0.0, clock)
                set_trace(entries, place, entry, env, trace, clock)
    for env in range(n_envs):
        clock[1 + env] += corrections[env] * clock[0]
    clock[0] *= state.gamma * trace_decay
    for env in range(n_envs):
        if ended[env]:
            end_episode(env, state, state)
    if state.n_active[0] == 0:
        state.trace_bound[0] = 0.0
    if clock[0] < LEAST_CLOCK:
        flush(state, state)
    state.sums[0] += size
    state.sums[1] += value_sum
    state.sums[2] += n_envs
    return OK


@inlined
def _advance(state):
    """Copy the ``NEXT`` states to the ``CURRENT`` ones."""
    indices, probabilities, entries, actions = (
        state.indices,
        state.probabilities,
        state.action_indices,
        state.actions,
    )
    _, n_envs, k, n_factors = entries.shape
    # Copy element by element: for arrays this small, numba's slices take longer.
    for env in range(n_envs):
        for j in range(actions.shape[2]):
            actions[CURRENT, env, j] = actions[NEXT, env, j]
        for i in range(k):
            indices[CURRENT, env, i] = indices[NEXT, env, i]
            probabilities[CURRENT, env, i] = probabilities[NEXT, env, i]
            for factor in range(n_factors):
                entries[CURRENT, env, i, factor] = entries[NEXT, env, i, factor]
    if state.n_rules > 0:
        state.forbidden[CURRENT] = state.forbidden[NEXT]


@inlined
def has_capacity(state):
    """Whether the arrays have capacity for all new points of the next step."""
    n_envs, k = state.indices.shape[1:]
    most = n_envs * k
    if len(state.active_points) - state.n_active[0] < most:
        return False
    return len(state.row_slots) == 0 or len(state.values) - state.n_rows[0] >= most


@inlined
def _are_valid(learning_rate, trace_decay, rate, state):
    """Whether the scheduled parameters are in range. NaN is not."""
    if not (0.0 <= learning_rate < np.inf and 0.0 <= trace_decay <= 1.0):
        return False
    return 0.0 < rate < np.inf if state.exploration == Exploration.SOFTMAX else 0.0 <= rate <= 1.0


@jit
def learn(state, observations, rewards, ended, learning_rate, trace_decay, rate):
    """
    Perceive the next states, select actions in them, and learn from the steps.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have ended, shape (n_envs,), bool
    :param learning_rate: α
    :param trace_decay: λ
    :param rate: ε or the temperature
    :return: ``OK``; or ``NEED_RANDOM``, ``NEED_CAPACITY``, ``NEED_POINTS`` or ``BAD_RATE``, in which case nothing has
        been changed; or ``NOT_FINITE`` or ``DIVERGED``, in which case no value has been changed
    """
    target_values = state.target_values
    if state.n_taken[0] == len(state.rows):
        return NEED_RANDOM
    if not has_capacity(state):
        return NEED_CAPACITY
    if not _are_valid(learning_rate, trace_decay, rate, state):
        return BAD_RATE
    uniforms = state.rows[state.n_taken[0]]
    are_new = False
    for env in range(len(rewards)):
        are_finite = np.isfinite(rewards[env])
        for j in range(observations.shape[1]):
            are_finite &= np.isfinite(observations[env, j])
        if not are_finite:
            # As in the torch learner, the row has been used.
            state.n_taken[0] += 1
            return NOT_FINITE
        are_new |= perceive_into(state, observations[env], NEXT, env)
        if state.truncated[env]:
            are_new |= perceive_into(state, state.last_observations[env], TERMINAL, env)
    if are_new:
        return NEED_POINTS
    state.n_taken[0] += 1
    count_steps(state.lengths, ended)
    for env in range(len(rewards)):
        if ended[env]:
            state.persistent[env, :] = UNDRAWN
        value = select_at(state, uniforms[env, 0], rate, NEXT, env)
        if state.truncated[env]:
            value = select_at(state, uniforms[env, 1], rate, TERMINAL, env)
        elif ended[env]:
            value = 0.0
        target_values[env] = value
    outcome = update_table(state, target_values, rewards, ended, learning_rate, trace_decay)
    if outcome == OK:
        record_steps(state, observations, rewards, ended)
        _advance(state)
    return outcome


@cache
def _learn_at(kind):
    @jit
    def learn_at(address, observations, rewards, ended, learning_rate, trace_decay, rate):
        return learn(state_at(address, kind), observations, rewards, ended, learning_rate, trace_decay, rate)

    return learn_at


def learn_with(state):
    """
    :param state: see :mod:`sb3_knntd.kernels.state`; the caller must keep it alive as long as the function is used
    :return: :func:`learn` with this state, a function of its other arguments
    """
    address, kind = address_of(state)
    return partial(_learn_at(kind), address)


@jit
def recommend(state, observations, uniforms, indices, probabilities, action_indices):
    """
    Find the columns that the neighbours select greedily for a batch of observations.

    :param state: with greedy selection, see :mod:`sb3_knntd.kernels.state`
    :param observations: observation units, shape (batch, obs_dim)
    :param uniforms: zeros, shape (n_uniforms,)
    :param indices: output, shape (batch, k), int64; with search ``OUTSIDE``, input
    :param probabilities: output, shape (batch, k); with search ``OUTSIDE``, it holds the squared distances on input
    :param action_indices: output, shape (batch, k, n_factors), int64
    """
    for row in range(len(observations)):
        perceive(observations[row], state, indices[row], probabilities[row])
        if state.n_rules > 0:
            apply_rules(observations[row], state, state.forbidden[CURRENT, 0])
        select(
            indices[row],
            probabilities[row],
            uniforms,
            0.0,
            state.persistent[0],
            state,
            state.forbidden[CURRENT, 0],
            action_indices[row],
            state.actions[CURRENT, 0],
        )


@jit
def update(
    state,
    observations,
    columns,
    rewards,
    next_observations,
    terminated,
    ended,
    found,
    distances,
    first,
    learning_rate,
    trace_decay,
):
    """
    Learn from given transitions, one after the other, by Watkins's Q(λ): the target is the value of the greedy action,
    and traces are cut before an action that is not greedy (Watkins 1989; Sutton and Barto, 2nd ed., section 12.10).

    :param state: of one environment, see :mod:`sb3_knntd.kernels.state`
    :param observations: observation units, shape (n, obs_dim)
    :param columns: the actions, a column for each factor, shape (n, n_factors), int64
    :param rewards: shape (n,)
    :param next_observations: observation units, shape (n, obs_dim)
    :param terminated: whether the next state is terminal, shape (n,), bool
    :param ended: whether the next transition does not continue this one, shape (n,), bool
    :param found: with search ``OUTSIDE``, the neighbours of both observations, shape (2, n, k), int64; otherwise unused
    :param distances: with search ``OUTSIDE``, their squared distances, shape (2, n, k); otherwise unused
    :param first: index of the first transition to learn from
    :param learning_rate: α
    :param trace_decay: λ
    :return: the index of the next transition, and ``OK``, ``NEED_CAPACITY`` or ``DIVERGED``
    """
    target_values, last = state.target_values, np.empty(1, np.bool_)
    reward = np.empty(1)
    goes_on = first > 0 and not ended[first - 1]
    for t in range(first, len(rewards)):
        if not has_capacity(state):
            return t, NEED_CAPACITY
        for which in (CURRENT, NEXT):
            indices, probabilities = state.indices[which, 0], state.probabilities[which, 0]
            if state.search == SearchKind.OUTSIDE:
                indices[:] = found[which, t]
                probabilities[:] = distances[which, t]
            observation = observations[t] if which == CURRENT else next_observations[t]
            perceive(observation, state, indices, probabilities)
            if state.n_rules > 0:
                apply_rules(observation, state, state.forbidden[which, 0])
        indices, probabilities = state.indices[CURRENT, 0], state.probabilities[CURRENT, 0]
        greedy, given = greedy_and_given_value(indices, probabilities, columns[t], state, state.forbidden[CURRENT, 0])
        if goes_on and given < greedy:
            end_episode(0, state, state)
            state.trace_bound[0] = 0.0
        for i in range(len(indices)):
            state.action_indices[CURRENT, 0, i] = columns[t]
        target_values[0] = 0.0
        if not terminated[t]:
            target_values[0], _ = greedy_and_given_value(
                state.indices[NEXT, 0], state.probabilities[NEXT, 0], columns[t], state, state.forbidden[NEXT, 0]
            )
        reward[0], last[0] = rewards[t], ended[t]
        outcome = update_table(state, target_values, reward, last, learning_rate, trace_decay)
        if outcome != OK:
            return t, outcome
        goes_on = not ended[t]
    return len(rewards), OK
