"""From an observation to the probabilities of its neighbours."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import jit
from sb3_knntd.kernels.nearest import nearest_of_all, nearest_on_lattice


class SearchKind(IntEnum):
    """How neighbours are found: on a lattice, among all points, or before the kernel is called."""

    LATTICE = 0
    ALL_POINTS = 1
    OUTSIDE = 2


class Weighting(IntEnum):
    """How neighbours are weighted by distance. The names in lower case are the words that users pass."""

    INVERSE_QUADRATIC = 0
    GAUSSIAN = 1


class PerceptionArguments(NamedTuple):
    """
    What :func:`perceive` needs besides the observation.

    :param low: lower bounds, observation units, shape (obs_dim,)
    :param width: upper minus lower bounds, observation units, shape (obs_dim,)
    :param limit: largest size of scaled values
    :param search: a :class:`SearchKind`
    :param axes: of the lattice, see :func:`~sb3_knntd.kernels.nearest.nearest_on_lattice`
    :param offsets: of the lattice, likewise
    :param columns: coordinates of the points, see :func:`~sb3_knntd.kernels.nearest.nearest_of_all`
    :param weighting: a :class:`Weighting`
    :param bandwidth: h, scaled units
    """

    low: np.ndarray
    width: np.ndarray
    limit: float
    search: int
    axes: np.ndarray
    offsets: np.ndarray
    columns: np.ndarray
    weighting: int
    bandwidth: float


@jit
def are_within(observations, low, high):
    """Whether all observations, shape (batch, obs_dim), lie within the bounds, shape (obs_dim,)."""
    for row in range(observations.shape[0]):
        for j in range(observations.shape[1]):
            if observations[row, j] < low[j] or observations[row, j] > high[j]:
                return False
    return True


@jit
def weigh(weighting, bandwidth, squared_distances):
    """Replace squared distances, rising, shape (k,), by weights that sum to 1 (eqs. 5 and 6)."""
    nearest, total = squared_distances[0], 0.0
    for i in range(len(squared_distances)):
        if weighting == Weighting.INVERSE_QUADRATIC:
            weight = 1.0 / (1.0 + squared_distances[i] / (bandwidth * bandwidth))
        elif weighting == Weighting.GAUSSIAN:
            weight = np.exp(-(squared_distances[i] - nearest) / (2.0 * (bandwidth * bandwidth)))
        else:
            raise ValueError("the kernels do not know this weighting")
        squared_distances[i] = weight
        total += weight
    for i in range(len(squared_distances)):
        squared_distances[i] /= total


@jit
def perceive(observation, arguments, indices, probabilities):
    """
    Bounds, search and weights of one observation.

    :param observation: observation units, shape (obs_dim,)
    :param arguments: see :class:`PerceptionArguments`
    :param indices: to be filled, or with search ``OUTSIDE`` given, shape (k,), int64
    :param probabilities: to be filled, shape (k,); with search ``OUTSIDE`` the squared distances are given in it
    """
    k = len(indices)
    if arguments.search != SearchKind.OUTSIDE:
        scaled = np.empty(len(observation))
        low, width, limit = arguments.low, arguments.width, arguments.limit
        for j in range(len(observation)):
            scaled[j] = min(max(2.0 * ((observation[j] - low[j]) / width[j]) - 1.0, -limit), limit)
        if arguments.search == SearchKind.LATTICE:
            nearest_on_lattice(scaled, arguments.axes, arguments.offsets, k, indices, probabilities)
        elif arguments.search == SearchKind.ALL_POINTS:
            nearest_of_all(scaled, arguments.columns, k, indices, probabilities)
        else:
            raise ValueError("the kernels do not know this search")
    weigh(arguments.weighting, arguments.bandwidth, probabilities)
