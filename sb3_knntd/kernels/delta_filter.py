"""
One step of the δs filter in all environments.

table          deltas (n_points, n_columns, obs_dim), observation units; visits (n_points, n_columns): how often each
               entry has been learned at, a visit shared among the neighbours as they count
statistics     of the innovations of all environments, by dimension: gains (obs_dim,), what the gain settles at;
               variances (obs_dim,); counts (1,): how many there were
states         of each environment: references (n_envs, obs_dim), the state that the next step starts from; doubts
               (n_envs, obs_dim), the variance of its error over that of an observation; innovations (n_envs, obs_dim),
               the last ones; follows (n_envs,), whether there is a last one
form           averaging, observed (reference), gain (which), fixed (obs_dim,), rate, warmup, training
"""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import jit
from sb3_knntd.kernels.perceive import perceive

#: What the innovation is multiplied by: what the update of the table makes of it, a given gain, or an adapted one.
OF_UPDATE, FIXED, ADAPTIVE = 0, 1, 2
#: The rate that stands for one over the visits, and how small that can get: a memory of a thousand visits.
COUNT, LEAST_RATE = -1.0, 1e-3

#: The gain moves by the innovations' correlation times 1 / (steps + 100), down to a memory of a thousand steps.
LEAST_PACE, FIRST_PACE = 1e-3, 1e-2
#: So many innovations tell their variance well enough to scale a correlation by.
ENOUGH = 20
#: One product of innovations counts as no more than so many variances, and the gain never lets observations go unheard.
LARGEST_CORRELATION, LEAST_GAIN = 3.0, 0.01


@jit
def advance(eyes, table, statistics, states, form, observations, columns, indices, probabilities, filtered):
    """
    Learn how each state changed, and estimate the state that each environment is in now.

    :param eyes: see :func:`~sb3_knntd.kernels.perceive.perceive`
    :param table: see the head of this module, as for the next three
    :param statistics: likewise
    :param states: likewise
    :param form: likewise
    :param observations: what is observed now, shape (n_envs, obs_dim), float64, finite
    :param columns: the actions that led here, shape (n_envs,), int64
    :param indices: to be used, or with search ``FOUND`` the neighbours of the references, shape (n_envs, k), int64
    :param probabilities: to be used, or with search ``FOUND`` their squared distances, shape (n_envs, k)
    :param filtered: to be filled with the estimates, shape (n_envs, obs_dim)
    """
    low, width, limit, search, axes, offsets, points, weights, bandwidth = eyes
    deltas, visits = table
    gains, variances, counts = statistics
    references, doubts, innovations, follows = states
    averaging, observed, gain, fixed, rate, warmup, training = form
    n_envs, k = indices.shape
    n_dims = observations.shape[1]
    rates = np.empty(k)
    for env in range(n_envs):
        column = columns[env]
        around, shares = indices[env], probabilities[env]
        perceive(references[env], low, width, limit, search, axes, offsets, points, weights, bandwidth, around, shares)
        visited, entry_doubt = 0.0, 0.0
        for i in range(k):
            visits_here = visits[around[i], column]
            visited += shares[i] * visits_here
            entry_doubt += shares[i] * shares[i] / visits_here if visits_here > 0.0 else np.inf
            rates[i] = shares[i] * (rate if rate != COUNT else max(1.0 / (visits_here + shares[i]), LEAST_RATE))
            if training:
                visits[around[i], column] = visits_here + shares[i]
        trusted = visited >= warmup

        adapts = training and trusted and gain == ADAPTIVE
        pace = memory = 0.0
        if adapts:
            counts[0] += 1.0
            memory = max(1.0 / counts[0], LEAST_PACE)
            pace = max(1.0 / (1.0 / FIRST_PACE + counts[0]), LEAST_PACE)
        for j in range(n_dims):
            delta = 0.0
            for i in range(k):
                delta += shares[i] * deltas[around[i], column, j]
            innovation = observations[env, j] - references[env, j] - delta

            correction = 0.0
            for i in range(k):
                error = innovation
                if averaging:
                    error = observations[env, j] - references[env, j] - deltas[around[i], column, j]
                correction += shares[i] * (rates[i] * error)
                if training:
                    deltas[around[i], column, j] += rates[i] * error

            if adapts:
                variances[j] += memory * (innovation * innovation - variances[j])
                if follows[env] and counts[0] > ENOUGH and variances[j] > 0.0:
                    correlation = innovation * innovations[env, j] / variances[j]
                    correlation = min(max(correlation, -LARGEST_CORRELATION), LARGEST_CORRELATION)
                    gains[j] = min(max(gains[j] + pace * correlation, LEAST_GAIN), 1.0)
            if gain == FIXED:
                correction = fixed[j] * innovation
            elif gain == ADAPTIVE:
                # One dimension of a Kalman filter whose process noise is that of the steady state, and the table's.
                doubt = doubts[env, j] + entry_doubt
                doubt += gains[j] * gains[j] / (1.0 - gains[j]) if gains[j] < 1.0 else np.inf
                doubts[env, j] = 1.0 - 1.0 / (1.0 + doubt)
                correction = doubts[env, j] * innovation

            if trusted:
                filtered[env, j] = references[env, j] + delta + correction
            else:
                filtered[env, j] = observations[env, j]
                doubts[env, j] = 1.0
            innovations[env, j] = innovation
            references[env, j] = observations[env, j] if observed else filtered[env, j]
        follows[env] = trusted
