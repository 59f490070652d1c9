"""The interface of neighbour searches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_knntd.kernels.nearest import order_candidates
from sb3_knntd.kernels.perceive import SearchKind
from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.points import Points


class Neighbors(NamedTuple):
    """
    The k nearest points of each observation, by distance and, at equal distance, by index.

    :param indices: shape (batch, k), int64
    :param squared_distances: shape (batch, k), float64, scaled units
    """

    indices: th.Tensor
    squared_distances: th.Tensor


class SearchArguments(NamedTuple):
    """
    The part of :class:`~sb3_knntd.kernels.perceive.PerceptionArguments` that a search provides.

    :param search: a :class:`~sb3_knntd.kernels.perceive.SearchKind`
    :param axes: of a lattice, see :func:`~sb3_knntd.kernels.nearest.nearest_on_lattice`
    :param offsets: of a lattice, likewise
    :param columns: coordinates of the points, see :func:`~sb3_knntd.kernels.nearest.nearest_of_all`
    """

    search: int
    axes: np.ndarray = np.empty(0)
    offsets: np.ndarray = np.empty(0, np.int64)
    columns: np.ndarray = np.empty((0, 0))


class Search(ABC):
    """
    Exact k-nearest-neighbour search in scaled units. Squared distances are summed in the order of the dimensions, and
    ties go to the lower index, so that all exact searches return the same.

    :param points: the points
    :param n_neighbors: k
    :raises ValueError: if the search cannot be used for these points
    """

    def __init__(self, points: Points, n_neighbors: int) -> None:
        self.points = points
        self.n_neighbors = n_neighbors

    @abstractmethod
    def fit(self, bounds: Bounds) -> None:
        """
        Read the coordinates of the points. Called again whenever the bounds or the points have changed.

        :param bounds: the range that is mapped to [-1, 1]
        """

    def extend(self, bounds: Bounds, added: th.Tensor) -> bool:
        """
        Read the coordinates of points that were added.

        :param bounds: the range that is mapped to [-1, 1], as in the last :meth:`fit`
        :param added: the new points, shape (n,), int64
        :return: whether :meth:`kernel_arguments` have changed
        """
        self.fit(bounds)
        return True

    @abstractmethod
    def query(self, scaled: th.Tensor) -> Neighbors:
        """
        :param scaled: observations in scaled units, shape (batch, obs_dim), float64
        :return: their neighbours
        """

    def kernel_arguments(self) -> SearchArguments:
        """
        :return: what the kernels need to search; by default, that the neighbours are found before they are called
        """
        return SearchArguments(int(SearchKind.OUTSIDE))


def nearest_of_candidates(queries: np.ndarray, places: np.ndarray, candidates: np.ndarray, k: int) -> Neighbors:
    """
    :param queries: shape (batch, obs_dim), scaled units
    :param places: the points, shape (n_points, obs_dim), scaled units
    :param candidates: points, at least k for each query, shape (batch, n), int64
    :param k: number of neighbours
    :return: the first k by (squared distance, index)
    """
    indices, distances = np.empty((len(queries), k), np.int64), np.empty((len(queries), k))
    order_candidates(queries, places, candidates, indices, distances)
    return Neighbors(th.from_numpy(indices), th.from_numpy(distances))
