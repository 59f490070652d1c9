"""Perception: from an observation to its neighbours and their probabilities."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from sb3_knntd.kernels.jit import inlined, jit
from sb3_knntd.kernels.nearest import nearest_of_all, nearest_on_lattice


class SearchKind(IntEnum):
    """How neighbours are found: on a lattice, among all points, or outside the kernel, before it is called."""

    LATTICE = 0
    ALL_POINTS = 1
    OUTSIDE = 2


class Weighting(IntEnum):
    """How neighbours are weighted by distance. Users pass the names in lower case."""

    INVERSE_QUADRATIC = 0
    GAUSSIAN = 1


class PerceptionArguments(NamedTuple):
    """
    Arguments of :func:`perceive` other than the observation.

    :param low: lower bounds, observation units, shape (obs_dim,)
    :param width: upper minus lower bounds, observation units, shape (obs_dim,)
    :param limit: scaled values are clipped to [-limit, limit]
    :param search: a :class:`SearchKind`
    :param axes: of the lattice, see :func:`~sb3_knntd.kernels.nearest.nearest_on_lattice`
    :param offsets: of the lattice, see :func:`~sb3_knntd.kernels.nearest.nearest_on_lattice`
    :param columns: coordinates of the points, see :func:`~sb3_knntd.kernels.nearest.nearest_of_all`
    :param weighting: a :class:`Weighting`
    :param bandwidth: h, scaled units
    :param squared_spacing: squared distance from the nearest point beyond which an observation becomes a point, scaled
        units; infinity if no points can be added
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
    squared_spacing: float = np.inf


@jit
def are_within(observations, low, high):
    """Whether all observations, shape (batch, obs_dim), lie within the bounds, shape (obs_dim,)."""
    for row in range(observations.shape[0]):
        for j in range(observations.shape[1]):
            if observations[row, j] < low[j] or observations[row, j] > high[j]:
                return False
    return True


@inlined
def scale(observation, low, width, limit):
    """Scale an observation, shape (obs_dim,), see :class:`PerceptionArguments`."""
    scaled = np.empty(len(observation))
    for j in range(len(observation)):
        scaled[j] = min(max(2.0 * ((observation[j] - low[j]) / width[j]) - 1.0, -limit), limit)
    return scaled


@jit
def first_far(observations, first, low, width, limit, columns, squared_spacing):
    """
    Find an observation that is far from all points.

    :param observations: observation units, shape (batch, obs_dim)
    :param first: the observation to begin with
    :param low: see :class:`PerceptionArguments`
    :param width: likewise
    :param limit: likewise
    :param columns: likewise
    :param squared_spacing: squared distance from the nearest point that counts as far, scaled units
    :return: the first observation that lies farther than that from all points; the length of the batch if none does
    """
    index, distance = np.empty(1, np.int64), np.empty(1)
    for row in range(first, len(observations)):
        nearest_of_all(scale(observations[row], low, width, limit), columns, 1, index, distance)
        if distance[0] > squared_spacing:
            return row
    return len(observations)


@jit
def weigh(weighting, bandwidth, squared_distances):
    """Replace squared distances in ascending order, shape (k,), by weights that sum to 1 (eqs. 5 and 6)."""
    nearest, total = squared_distances[0], 0.0
    if nearest == np.inf:
        # There are no points yet.
        squared_distances[:] = 1.0 / len(squared_distances)
        return
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
    Scale an observation, find its neighbours and compute their probabilities.

    :param observation: observation units, shape (obs_dim,)
    :param arguments: see :class:`PerceptionArguments`
    :param indices: output, shape (k,), int64; with search ``OUTSIDE``, input
    :param probabilities: output, shape (k,); with search ``OUTSIDE``, it holds the squared distances on input
    :return: squared distance of the nearest point, scaled units
    """
    k = len(indices)
    if arguments.search != SearchKind.OUTSIDE:
        scaled = scale(observation, arguments.low, arguments.width, arguments.limit)
        if arguments.search == SearchKind.LATTICE:
            nearest_on_lattice(scaled, arguments.axes, arguments.offsets, k, indices, probabilities)
        elif arguments.search == SearchKind.ALL_POINTS:
            nearest_of_all(scaled, arguments.columns, k, indices, probabilities)
        else:
            raise ValueError("the kernels do not know this search")
    nearest = probabilities[0]
    weigh(arguments.weighting, arguments.bandwidth, probabilities)
    return nearest
