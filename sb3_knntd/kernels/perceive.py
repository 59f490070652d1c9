"""From an observation to its neighbours' probabilities."""

from __future__ import annotations

import numpy as np

from sb3_knntd.kernels.jit import jit
from sb3_knntd.kernels.nearest import nearest_of_all, nearest_on_lattice

#: How neighbours are found: in the kernel on a lattice, in the kernel among all points, or before it is called.
LATTICE, ALL, FOUND = 0, 1, 2
#: How they are weighed.
INVERSE_QUADRATIC, GAUSSIAN = 0, 1


@jit
def are_within(observations, low, high):
    """Whether all observations, shape (batch, obs_dim), lie within the bounds, shape (obs_dim,)."""
    for row in range(observations.shape[0]):
        for j in range(observations.shape[1]):
            if observations[row, j] < low[j] or observations[row, j] > high[j]:
                return False
    return True


@jit
def perceive(
    observation, low, width, limit, search, axes, offsets, columns, weights, bandwidth, indices, probabilities
):
    """
    Bounds, search and weights of one observation. All but the first and the last two arguments are ``eyes``, in
    this order, wherever that is spoken of.

    :param observation: observation units, shape (obs_dim,)
    :param low: lower bounds, observation units, shape (obs_dim,)
    :param width: upper less lower bounds, likewise
    :param limit: how far scaled values reach
    :param search: ``LATTICE``, ``ALL`` or ``FOUND``
    :param axes: of the lattice, see :func:`~sb3_knntd.kernels.nearest.nearest_on_lattice`
    :param offsets: likewise
    :param columns: of the points, see :func:`~sb3_knntd.kernels.nearest.nearest_of_all`
    :param weights: ``INVERSE_QUADRATIC`` or ``GAUSSIAN``
    :param bandwidth: h, scaled units
    :param indices: to be filled, or with search ``FOUND`` given, shape (k,), int64
    :param probabilities: to be filled, shape (k,); with search ``FOUND`` the squared distances are given in it
    """
    k = len(indices)
    if search != FOUND:
        scaled = np.empty(len(observation))
        for j in range(len(observation)):
            scaled[j] = min(max(2.0 * ((observation[j] - low[j]) / width[j]) - 1.0, -limit), limit)
        if search == LATTICE:
            nearest_on_lattice(scaled, axes, offsets, k, indices, probabilities)
        else:
            nearest_of_all(scaled, columns, k, indices, probabilities)
    nearest = probabilities[0]
    together = 0.0
    for i in range(k):
        if weights == INVERSE_QUADRATIC:
            probabilities[i] = 1.0 / (1.0 + probabilities[i] / (bandwidth * bandwidth))
        else:
            probabilities[i] = np.exp(-(probabilities[i] - nearest) / (2.0 * (bandwidth * bandwidth)))
        together += probabilities[i]
    for i in range(k):
        probabilities[i] /= together
