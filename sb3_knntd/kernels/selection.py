"""Action selection: from the values of the neighbours to an action and the value of the state as a target."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import inlined, jit
from sb3_knntd.kernels.traces import read_row


class Target(IntEnum):
    """The target value of the next state. Users pass the names in lower case."""

    SARSA = 0
    Q_LEARNING = 1
    EXPECTED_SARSA = 2


class Exploration(IntEnum):
    """How actions are explored. Users pass the names in lower case."""

    EPSILON_GREEDY = 0
    SOFTMAX = 1
    PER_NEIGHBOR = 2
    SHARED = 3


class Combination(IntEnum):
    """Select one action from the mean of the neighbours' rows, or one from each row and average the actions."""

    OF_VALUES = 0
    OF_ACTIONS = 1


#: Special values of persistent actions: take the greedy action; not yet drawn in this episode.
GREEDY, UNDRAWN = -1, -2


class SelectionArguments(NamedTuple):
    """
    Arguments of action selection other than values.

    :param combination: a :class:`Combination`
    :param target: a :class:`Target`
    :param exploration: an :class:`Exploration`
    :param random_ties: whether ties between best actions are broken at random, otherwise the first is taken
    :param min_persistence: lower limit of the mean number of steps for which a shared draw is kept
    :param persistence_share: share of an episode for which a shared draw is kept on average, if that is longer
    :param factors: index of the first column of each action factor, and the number of columns, shape (n_factors + 1,),
        int64
    :param action_points: the action of each column, shape (n_actions, action_dim), action units
    :param n_rules: number of rules that forbid actions in a region
    :param rule_low: the lower corners of the regions, shape (n_rules, obs_dim), observation units
    :param rule_high: the upper corners of the regions, shape (n_rules, obs_dim), observation units
    :param rule_columns: the columns that each rule forbids, shape (n_rules, n_actions), bool
    """

    combination: int
    target: int
    exploration: int
    random_ties: bool
    min_persistence: float
    persistence_share: float
    factors: np.ndarray
    action_points: np.ndarray
    n_rules: int
    rule_low: np.ndarray
    rule_high: np.ndarray
    rule_columns: np.ndarray


@jit
def apply_rules(observation, selection, forbidden):
    """
    Find the columns that the rules forbid in a state.

    :param observation: observation units, shape (obs_dim,)
    :param selection: see :class:`SelectionArguments`
    :param forbidden: output, shape (n_actions,), bool
    """
    forbidden[:] = False
    for rule in range(selection.n_rules):
        inside = True
        for j in range(len(observation)):
            if not selection.rule_low[rule, j] <= observation[j] <= selection.rule_high[rule, j]:
                inside = False
        if inside:
            for action in range(len(forbidden)):
                forbidden[action] |= selection.rule_columns[rule, action]


@inlined
def mask(row, forbidden):
    """Set the values of forbidden columns to -inf."""
    for action in range(len(row)):
        if forbidden[action]:
            row[action] = -np.inf


@inlined
def pick(uniform, n):
    """An integer in [0, n) from a uniform random number."""
    return min(np.int64(uniform * n), n - 1)


@inlined
def pick_allowed(values, uniform):
    """A random one of the actions whose value is not -inf."""
    n_allowed = 0
    for action in range(len(values)):
        if values[action] > -np.inf:
            n_allowed += 1
    rank = pick(uniform, n_allowed)
    for action in range(len(values)):
        if values[action] > -np.inf:
            if rank == 0:
                return action
            rank -= 1
    return 0


@inlined
def largest(values, first, end):
    """The largest of ``values[first:end]``."""
    value = values[first]
    for action in range(first + 1, end):
        if values[action] > value:
            value = values[action]
    return value


@inlined
def greedy_action(values, first, end, uniform, random_ties):
    """The best action in ``[first, end)``; ties are broken at random, or the first is taken."""
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


@inlined
def _explore(values, uniforms, rate, exploration, random_ties, shares):
    """The action to take (eqs. 9 and 10). With softmax, the probabilities of all actions are written to ``shares``."""
    n_actions = len(values)
    if exploration == Exploration.EPSILON_GREEDY:
        if uniforms[0] < rate:
            return pick_allowed(values, uniforms[1])
        return greedy_action(values, 0, n_actions, uniforms[1], random_ties)
    if exploration == Exploration.SOFTMAX:
        _softmax(values, rate, shares)
        total, reached, action = shares.sum(), 0.0, 0
        for candidate in range(n_actions):
            reached += shares[candidate]
            if shares[candidate] > 0.0:
                action = candidate
            if uniforms[0] * total < reached:
                break
        return action
    raise ValueError("the kernels do not know this exploration of discrete actions")


@inlined
def _target_value(values, action, rate, target, exploration, shares):
    """The value of the state as a target (eqs. 11 and 12, and the mean under the exploration policy)."""
    n_actions = len(values)
    if target == Target.SARSA:
        return values[action]
    best = largest(values, 0, n_actions)
    if target == Target.Q_LEARNING:
        return best
    if target == Target.EXPECTED_SARSA:
        mean = 0.0
        if exploration == Exploration.EPSILON_GREEDY:
            n_allowed = 0
            for candidate in range(n_actions):
                if values[candidate] > -np.inf:
                    mean += values[candidate]
                    n_allowed += 1
            return (1.0 - rate) * best + rate * (mean / n_allowed)
        for candidate in range(n_actions):
            if shares[candidate] > 0.0:
                mean += shares[candidate] * values[candidate]
        return mean
    raise ValueError("the kernels do not know this target")


@inlined
def _mean_row(indices, probabilities, state, means, row):
    """Q(s, ·) of a state (eq. 8), written into ``means``."""
    values, row_slots, initial_value = state.values, state.row_slots, state.initial_value
    entries, slots, clock = state.active_entries, state.active_slots, state.clock
    means[:] = 0.0
    for i in range(len(indices)):
        read_row(indices[i], values, row_slots, initial_value, entries, slots, clock, row)
        for action in range(len(means)):
            means[action] += probabilities[i] * row[action]


@inlined
def _select_from_mean(indices, probabilities, uniforms, rate, state, forbidden, action_indices):
    means, row = state.means, state.row
    _mean_row(indices, probabilities, state, means, row)
    if state.n_rules > 0:
        mask(means, forbidden)
    action = _explore(means, uniforms, rate, state.exploration, state.random_ties, row)
    for i in range(len(indices)):
        action_indices[i, 0] = action
    return _target_value(means, action, rate, state.target, state.exploration, row)


@inlined
def _select_from_each(
    indices, probabilities, uniforms, rate, persistent, state, forbidden, action_indices, mean_action
):
    values, row_slots, initial_value = state.values, state.row_slots, state.initial_value
    entries, slots, clock = state.active_entries, state.active_slots, state.clock
    factors, action_points, row = state.factors, state.action_points, state.row
    k, n_factors = action_indices.shape
    mean_action[:] = 0.0
    value = 0.0
    for i in range(k):
        read_row(indices[i], values, row_slots, initial_value, entries, slots, clock, row)
        if state.n_rules > 0:
            mask(row, forbidden)
        for factor in range(n_factors):
            first, end = factors[factor], factors[factor + 1]
            uniform = uniforms[2 + n_factors + i * n_factors + factor]
            column = greedy_action(row, first, end, uniform, state.random_ties)
            value += probabilities[i] * row[column]
            if state.exploration == Exploration.SHARED:
                if persistent[factor] >= 0 and row[persistent[factor]] > -np.inf:
                    column = persistent[factor]
            elif state.exploration == Exploration.PER_NEIGHBOR:
                if uniforms[2 + n_factors + (k + i) * n_factors + factor] < rate:
                    drawn = first + pick(uniform, end - first)
                    if row[drawn] > -np.inf:
                        column = drawn
            else:
                raise ValueError("the kernels do not know this exploration of continuous actions")
            action_indices[i, factor] = column
            for j in range(len(mean_action)):
                mean_action[j] += probabilities[i] * action_points[column, j]
    return value / n_factors


@inlined
def select(indices, probabilities, uniforms, rate, persistent, state, forbidden, action_indices, mean_action):
    """
    Select the action in one state (eqs. 8 to 10; eqs. 19 to 21 and 27).

    :param indices: neighbours, shape (k,)
    :param probabilities: of the neighbours, shape (k,)
    :param uniforms: random numbers in [0, 1), shape (n_uniforms,)
    :param rate: ε or the temperature
    :param persistent: columns being explored, or ``GREEDY`` or ``UNDRAWN``, shape (n_factors,)
    :param state: see :mod:`sb3_knntd.kernels.state`
    :param forbidden: columns that must not be selected, shape (n_actions,), bool; not read if there are no rules
    :param action_indices: output, the column that each neighbour selects for each factor, shape (k, n_factors)
    :param mean_action: output, the mean of the action points, shape (action_dim,)
    :return: the value of the state as a target (eqs. 11, 12 and 25)
    """
    if state.combination == Combination.OF_VALUES:
        return _select_from_mean(indices, probabilities, uniforms, rate, state, forbidden, action_indices)
    if state.combination == Combination.OF_ACTIONS:
        return _select_from_each(
            indices, probabilities, uniforms, rate, persistent, state, forbidden, action_indices, mean_action
        )
    raise ValueError("the kernels do not know this combination")


@jit
def greedy_and_given_value(indices, probabilities, columns, state, forbidden):
    """
    The values of the greedy action and of a given action in a state. The given one may be forbidden.

    :param indices: neighbours, shape (k,)
    :param probabilities: of the neighbours, shape (k,)
    :param columns: the given action, a column for each factor, shape (n_factors,)
    :param state: see :mod:`sb3_knntd.kernels.state`
    :param forbidden: columns that are not greedy, shape (n_actions,), bool; not read if there are no rules
    :return: both values
    """
    means, row, factors = state.means, state.row, state.factors
    if state.combination == Combination.OF_VALUES:
        _mean_row(indices, probabilities, state, means, row)
        given = means[columns[0]]
        if state.n_rules > 0:
            mask(means, forbidden)
        return largest(means, 0, len(means)), given
    values, row_slots, initial_value = state.values, state.row_slots, state.initial_value
    entries, slots, clock = state.active_entries, state.active_slots, state.clock
    n_factors = len(columns)
    greedy, given = 0.0, 0.0
    for i in range(len(indices)):
        read_row(indices[i], values, row_slots, initial_value, entries, slots, clock, row)
        for factor in range(n_factors):
            given += probabilities[i] * row[columns[factor]] / n_factors
        if state.n_rules > 0:
            mask(row, forbidden)
        for factor in range(n_factors):
            greedy += probabilities[i] * largest(row, factors[factor], factors[factor + 1]) / n_factors
    return greedy, given


@jit
def persist(uniforms, rate, lengths, env, selection, persistent):
    """
    Keep the persistent action, or redraw whether to explore and which columns. On average a draw is kept for
    ``min_persistence`` steps, or for ``persistence_share`` of an episode if that is longer. The expected length of an
    episode is the mean length, or the current number of steps if that is larger.

    :param uniforms: random numbers in [0, 1), of which the first 2 + n_factors are used
    :param rate: ε, the share of draws that explore
    :param lengths: see :func:`count_steps`
    :param env: index of the environment
    :param selection: see :class:`SelectionArguments`
    :param persistent: columns being explored, or ``GREEDY`` or ``UNDRAWN``, shape (n_factors,); updated in place
    """
    steps = max(selection.min_persistence, selection.persistence_share * max(lengths[0], lengths[1 + env]))
    if persistent[0] == UNDRAWN or uniforms[0] * steps < 1.0:
        for factor in range(len(persistent)):
            first, end = selection.factors[factor], selection.factors[factor + 1]
            persistent[factor] = first + pick(uniforms[2 + factor], end - first) if uniforms[1] < rate else GREEDY


@jit
def count_steps(lengths, ended):
    """
    Update the mean length of episodes.

    :param lengths: the moving average of the lengths of episodes, with weight 0.2 of the last one (0 if none has
        ended), and the number of steps of the current episode in each environment, shape (1 + n_envs,); updated in
        place
    :param ended: whether the current step has ended the episode, shape (n_envs,), bool
    """
    for env in range(len(ended)):
        lengths[1 + env] += 1.0
        if ended[env]:
            lengths[0] += (1.0 if lengths[0] == 0.0 else 0.2) * (lengths[1 + env] - lengths[0])
            lengths[1 + env] = 0.0
