"""One step of kNN-TD(λ) in all environments."""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import inlined, jit
from sb3_knntd.kernels.perceive import perceive
from sb3_knntd.kernels.selection import (
    UNDRAWN,
    Combination,
    Exploration,
    count_steps,
    largest,
    persist,
    select,
)
from sb3_knntd.kernels.traces import (
    LEAST_CLOCK,
    activate,
    active_value,
    end_episode,
    find,
    flush,
    read_active_row,
    set_trace,
)

#: Which state's arrays: that the environment left, that it is in, or the last one before a truncation.
CURRENT, NEXT, TERMINAL = 0, 1, 2


#: Outcomes of a step: done; more random numbers or more rows are needed; or what the environments returned, or what the
#: table would become, is not finite. Plain numbers: an enumeration's member takes half a microsecond to hand back.
OK, NEED_RANDOM, NEED_CAPACITY, NOT_FINITE, DIVERGED = range(5)


@jit
def perceive_and_select(state, observation, uniforms, rate, which, env):
    """
    Perceive an observation and select an action. Both are stored in the state.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observation: observation units, shape (obs_dim,)
    :param uniforms: random numbers in [0, 1), shape (n_uniforms,)
    :param rate: ε or the temperature
    :param which: ``CURRENT``, ``NEXT`` or ``TERMINAL``
    :param env: which environment
    :return: the value of the state as a target
    """
    indices, probabilities = state.indices[which, env], state.probabilities[which, env]
    persistent = state.persistent[env]
    perceive(observation, state, indices, probabilities)
    # The action at a truncated state is never executed; leave the persistent action unchanged.
    if state.exploration == Exploration.SHARED and which != TERMINAL:
        persist(uniforms, rate, state.lengths, env, state, persistent)
    action_indices, mean_action = state.action_indices[which, env], state.actions[which, env]
    return select(indices, probabilities, uniforms, rate, persistent, state, action_indices, mean_action)


@jit
def begin(state, observations, uniforms, rate):
    """
    Perceive and select where every environment begins an episode.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param uniforms: random numbers in [0, 1), shape (n_envs, n_uniforms)
    :param rate: ε or the temperature
    """
    state.lengths[1:] = 0.0
    for env in range(len(observations)):
        state.persistent[env, :] = UNDRAWN
        perceive_and_select(state, observations[env], uniforms[env], rate, CURRENT, env)


@inlined
def update_table(state, target_values, rewards, ended, learning_rate, trace_decay):
    """
    Compute the TD errors of the steps from the ``CURRENT`` states, and credit them along the traces (Algorithm 3), in all
    environments at once: every value is read before any is changed.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param target_values: values of the states that the steps led to, 0 where an episode was terminated, shape (n_envs,)
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have, shape (n_envs,), bool
    :param learning_rate: α
    :param trace_decay: λ
    :return: ``OK``, or ``DIVERGED``, and then no value has been changed
    """
    indices, probabilities = state.indices[CURRENT], state.probabilities[CURRENT]
    chosen = state.action_indices[CURRENT]
    places, corrections, row, factors = state.places, state.corrections, state.row, state.factors
    entries, slots, clock = state.active_entries, state.active_slots, state.clock
    n_envs, k, n_factors = chosen.shape
    size, value_sum = 0.0, 0.0
    for env in range(n_envs):
        value, squares = 0.0, 0.0
        for i in range(k):
            point = indices[env, i]
            place = find(point, slots)
            if place < 0:
                place = activate(point, state, state)
            places[env, i] = place
            probability = probabilities[env, i]
            if state.combination == Combination.OF_VALUES:
                value += probability * active_value(entries, place, chosen[env, i, 0], clock)
            else:
                read_active_row(entries, place, clock, row)
                for factor in range(n_factors):
                    value += probability * largest(row, factors[factor], factors[factor + 1]) / n_factors
            squares += probability * probability
        error = rewards[env] + state.gamma * target_values[env] - value
        corrections[env] = learning_rate * error / squares if state.normalized else learning_rate * error
        if not np.isfinite(corrections[env]):
            return DIVERGED
        size += abs(error)
        value_sum += value

    for env in range(n_envs):
        for i in range(k):
            place, trace = places[env, i], probabilities[env, i] / clock[0]
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
    if clock[0] < LEAST_CLOCK:
        flush(state, state)
    state.sums[0] += size
    state.sums[1] += value_sum
    state.sums[2] += n_envs
    return OK


@inlined
def _advance(state):
    """The states that the step led to are now those that the environments are in."""
    indices, probabilities, entries, actions = (
        state.indices,
        state.probabilities,
        state.action_indices,
        state.actions,
    )
    _, n_envs, k, n_factors = entries.shape
    # Elements are copied one by one: for arrays this small numba's slices take longer.
    for env in range(n_envs):
        for j in range(actions.shape[2]):
            actions[CURRENT, env, j] = actions[NEXT, env, j]
        for i in range(k):
            indices[CURRENT, env, i] = indices[NEXT, env, i]
            probabilities[CURRENT, env, i] = probabilities[NEXT, env, i]
            for factor in range(n_factors):
                entries[CURRENT, env, i, factor] = entries[NEXT, env, i, factor]


@inlined
def has_capacity(state):
    """Whether there is room for all points that the next step may come upon."""
    n_envs, k = state.indices.shape[1:]
    most = n_envs * k
    if len(state.active_points) - state.n_active[0] < most:
        return False
    return len(state.row_slots) == 0 or len(state.values) - state.n_rows[0] >= most


@jit
def learn(state, observations, rewards, ended, learning_rate, trace_decay, rate):
    """
    Perceive and select in the states that the last actions led to, and learn from the steps.

    :param state: see :mod:`sb3_knntd.kernels.state`
    :param observations: observation units, shape (n_envs, obs_dim)
    :param rewards: shape (n_envs,)
    :param ended: whether the episodes have, shape (n_envs,), bool
    :param learning_rate: α
    :param trace_decay: λ
    :param rate: ε or the temperature
    :return: ``OK``; or ``NEED_RANDOM`` or ``NEED_CAPACITY``, and then nothing has been done; or ``NOT_FINITE`` or
        ``DIVERGED``, and then no value has been changed
    """
    target_values = state.target_values
    if state.n_taken[0] == len(state.rows):
        return NEED_RANDOM
    if not has_capacity(state):
        return NEED_CAPACITY
    uniforms = state.rows[state.n_taken[0]]
    state.n_taken[0] += 1
    count_steps(state.lengths, ended)
    for env in range(len(rewards)):
        if not np.isfinite(rewards[env]):
            return NOT_FINITE
        for j in range(observations.shape[1]):
            if not np.isfinite(observations[env, j]):
                return NOT_FINITE
        if ended[env]:
            state.persistent[env, :] = UNDRAWN
        value = perceive_and_select(state, observations[env], uniforms[env, 0], rate, NEXT, env)
        if state.truncated[env]:
            value = perceive_and_select(state, state.last_observations[env], uniforms[env, 1], rate, TERMINAL, env)
        elif ended[env]:
            value = 0.0
        target_values[env] = value
    outcome = update_table(state, target_values, rewards, ended, learning_rate, trace_decay)
    if outcome == OK:
        _advance(state)
    return outcome


from functools import cache, partial
from sb3_knntd.kernels.state import place_of, state_at
@cache
def _learn_at(kind):
    @jit
    def learn_at(address, observations, rewards, ended, learning_rate, trace_decay, rate):
        return learn(state_at(address, kind), observations, rewards, ended, learning_rate, trace_decay, rate)

    return learn_at


def learn_on(desk):
    address, kind = place_of(desk)
    return partial(_learn_at(kind), address)
