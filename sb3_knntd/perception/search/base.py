"""What every neighbour search does."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.kernels.nearest import order_candidates
from sb3_knntd.kernels.perceive import FOUND
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


class Search(ABC):
    """
    Exact k-nearest-neighbour search in scaled units. Squared distances are summed over the dimensions in
    their order, and ties go to the lower index, so that every search gives the same answer.

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
        Take in the places of the points; called again whenever the bounds have moved.

        :param bounds: the range that is mapped to [-1, 1]
        """

    @abstractmethod
    def query(self, scaled: th.Tensor) -> Neighbors:
        """
        :param scaled: observations in scaled units, shape (batch, obs_dim), float64
        :return: their neighbours
        """

    def kernel_arguments(self) -> tuple[Any, ...]:
        """
        :return: search, axes, offsets and columns of ``eyes`` of :func:`sb3_knntd.kernels.perceive.perceive`; by
            default it is told that neighbours are found before it is called
        """
        return FOUND, np.empty(0), np.empty(0, np.int64), np.empty((0, 0))


def nearest_by_tensors(scaled: th.Tensor, places: th.Tensor, k: int) -> Neighbors:
    """
    The answer of every exact search by torch's most common operations, which can be traced and exported.

    :param scaled: observations in scaled units, shape (batch, obs_dim)
    :param places: the points, shape (n_points, obs_dim), scaled units
    :param k: number of neighbours
    :return: the first k by (squared distance, index)
    """
    distances = th.zeros_like(scaled[:, :1] * places[:, 0])
    for dimension in range(places.shape[1]):
        distances = distances + (scaled[:, dimension, None] - places[:, dimension]).square()
    indices, nearest = [], []
    for _ in range(k):
        # The first of several equals.
        index = distances.argmin(dim=1, keepdim=True)
        indices.append(index)
        nearest.append(distances.gather(1, index))
        distances = distances.scatter(1, index, th.inf)
    return Neighbors(th.cat(indices, dim=1), th.cat(nearest, dim=1))


def nearest_of_candidates(queries: np.ndarray, places: np.ndarray, candidates: np.ndarray, k: int) -> Neighbors:
    """
    :param queries: shape (batch, obs_dim), scaled units
    :param places: the points, shape (n_points, obs_dim), scaled units
    :param candidates: at least k of them for each query, shape (batch, n), int64
    :param k: number of neighbours
    :return: the first k by (squared distance, index)
    """
    indices, distances = np.empty((len(queries), k), np.int64), np.empty((len(queries), k))
    order_candidates(queries, places, candidates, indices, distances)
    return Neighbors(th.from_numpy(indices), th.from_numpy(distances))
