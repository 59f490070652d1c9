"""One step of the δs filter in all environments."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import inlined, jit
from sb3_knntd.kernels.perceive import PerceptionArguments, perceive


class GainRule(IntEnum):
    """What determines the gain of the innovation: the update of the table, a given number, or adaptation."""

    OF_UPDATE = 0
    FIXED = 1
    ADAPTIVE = 2


class DeltaTableArrays(NamedTuple):
    """
    The learned values of each point and action.

    :param deltas: expected changes of the state, shape (n_points, n_columns, obs_dim), observation units
    :param visits: sums of the probabilities with which the entries were visited, shape (n_points, n_columns)
    """

    deltas: np.ndarray
    visits: np.ndarray


class InnovationStatistics(NamedTuple):
    """
    Statistics of the innovations of all environments.

    :param gains: the stationary gain that was adapted, shape (obs_dim,)
    :param variances: variances of the innovations, shape (obs_dim,)
    :param counts: number of innovations, shape (1,)
    """

    gains: np.ndarray
    variances: np.ndarray
    counts: np.ndarray


class FilterStates(NamedTuple):
    """
    The state of the filter in each environment.

    :param references: the state that the next step is predicted from, shape (n_envs, obs_dim)
    :param error_variances: variance of the reference's error over that of an observation, shape (n_envs, obs_dim)
    :param innovations: the last innovations, shape (n_envs, obs_dim)
    :param follows: whether the last innovation belongs to the same episode and can be used, shape (n_envs,), bool
    """

    references: np.ndarray
    error_variances: np.ndarray
    innovations: np.ndarray
    follows: np.ndarray


class FilterConfig(NamedTuple):
    """
    The variant of the filter, and its rates at this step.

    :param averaging: whether each entry moves towards the observed change, instead of by the error of the mean
    :param observed: whether changes start from the last observation, instead of the last estimate
    :param gain_rule: a :class:`GainRule`
    :param fixed_gain: the gain of ``FIXED``, shape (obs_dim,)
    :param learning_rate: α, or ``COUNT``
    :param warmup: visits that a prediction needs to be trusted
    :param training: whether to learn
    """

    averaging: bool
    observed: bool
    gain_rule: int
    fixed_gain: np.ndarray
    learning_rate: float
    warmup: float
    training: bool


#: Special value of the learning rate for 1 / visits, and its lower limit: a memory of 1000 visits.
COUNT, LEAST_RATE = -1.0, 1e-3
#: The gain moves by the correlation of the innovations times 1 / (n + 100), at least 1e-3: a memory of 1000 steps.
LEAST_GAIN_RATE, FIRST_GAIN_RATE = 1e-3, 1e-2
#: Number of innovations whose variance is accurate enough to scale a correlation.
ENOUGH = 20
#: A product of innovations is clipped to this many variances.
LARGEST_CORRELATION = 3.0
#: Lower limit of the gain, so that the filter still follows the observations.
LEAST_GAIN = 0.01


@inlined
def _advance(arguments, table, statistics, states, config, observations, columns, indices, probabilities, filtered):
    """:func:`advance` with named tuples."""
    deltas, visits = table.deltas, table.visits
    gains, variances, counts = statistics.gains, statistics.variances, statistics.counts
    references, error_variances = states.references, states.error_variances
    n_envs, k = indices.shape
    n_dims = observations.shape[1]
    rates = np.empty(k)
    for env in range(n_envs):
        column = columns[env]
        around, shares = indices[env], probabilities[env]
        perceive(references[env], arguments, around, shares)
        visited, table_variance = 0.0, 0.0
        for i in range(k):
            visits_here = visits[around[i], column]
            visited += shares[i] * visits_here
            table_variance += shares[i] * shares[i] / visits_here if visits_here > 0.0 else np.inf
            rate = config.learning_rate
            if rate == COUNT:
                rate = max(1.0 / (visits_here + shares[i]), LEAST_RATE)
            rates[i] = shares[i] * rate
            if config.training:
                visits[around[i], column] = visits_here + shares[i]
        trusted = visited >= config.warmup

        adapts = config.training and trusted and config.gain_rule == GainRule.ADAPTIVE
        gain_rate = variance_rate = 0.0
        if adapts:
            counts[0] += 1.0
            variance_rate = max(1.0 / counts[0], LEAST_GAIN_RATE)
            gain_rate = max(1.0 / (1.0 / FIRST_GAIN_RATE + counts[0]), LEAST_GAIN_RATE)
        for j in range(n_dims):
            delta = 0.0
            for i in range(k):
                delta += shares[i] * deltas[around[i], column, j]
            innovation = observations[env, j] - references[env, j] - delta

            correction = 0.0
            for i in range(k):
                error = innovation
                if config.averaging:
                    error = observations[env, j] - references[env, j] - deltas[around[i], column, j]
                correction += shares[i] * (rates[i] * error)
                if config.training:
                    deltas[around[i], column, j] += rates[i] * error

            if adapts:
                variances[j] += variance_rate * (innovation * innovation - variances[j])
                if states.follows[env] and counts[0] > ENOUGH and variances[j] > 0.0:
                    correlation = innovation * states.innovations[env, j] / variances[j]
                    correlation = min(max(correlation, -LARGEST_CORRELATION), LARGEST_CORRELATION)
                    gains[j] = min(max(gains[j] + gain_rate * correlation, LEAST_GAIN), 1.0)
            if config.gain_rule == GainRule.FIXED:
                correction = config.fixed_gain[j] * innovation
            elif config.gain_rule == GainRule.ADAPTIVE:
                # A one-dimensional Kalman filter. Its process noise is the one that makes the adapted gain stationary,
                # plus the variance of the table's entries.
                predicted = error_variances[env, j] + table_variance
                predicted += gains[j] * gains[j] / (1.0 - gains[j]) if gains[j] < 1.0 else np.inf
                error_variances[env, j] = 1.0 - 1.0 / (1.0 + predicted)
                correction = error_variances[env, j] * innovation
            elif config.gain_rule != GainRule.OF_UPDATE:
                raise ValueError("the kernels do not know this gain rule")

            if trusted:
                filtered[env, j] = references[env, j] + delta + correction
            else:
                filtered[env, j] = observations[env, j]
                error_variances[env, j] = 1.0
            states.innovations[env, j] = innovation
            references[env, j] = observations[env, j] if config.observed else filtered[env, j]
        states.follows[env] = trusted


@jit
def advance(arguments, table, statistics, states, config, observations, columns, indices, probabilities, filtered):
    """
    Learn from the change of each state, and estimate the current state of each environment.

    The first five arguments are named tuples converted to plain tuples, each of which numba unboxes 1.5 µs faster.

    :param arguments: see :class:`~sb3_knntd.kernels.perceive.PerceptionArguments`
    :param table: see :class:`DeltaTableArrays`
    :param statistics: see :class:`InnovationStatistics`
    :param states: see :class:`FilterStates`
    :param config: see :class:`FilterConfig`
    :param observations: the current observations, shape (n_envs, obs_dim), float64, finite
    :param columns: the actions that led to them, shape (n_envs,), int64
    :param indices: work space, or with search ``OUTSIDE`` the neighbours of the references, shape (n_envs, k), int64
    :param probabilities: work space, or with search ``OUTSIDE`` their squared distances, shape (n_envs, k)
    :param filtered: output, the estimates, shape (n_envs, obs_dim), observation units
    """
    _advance(
        PerceptionArguments(*arguments),
        DeltaTableArrays(*table),
        InnovationStatistics(*statistics),
        FilterStates(*states),
        FilterConfig(*config),
        observations,
        columns,
        indices,
        probabilities,
        filtered,
    )
