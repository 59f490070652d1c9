"""Exact search with tensor operations alone, which can be traced and exported."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import torch as th

from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search.base import Neighbors

#: Largest number of points that are compared for each observation.
MOST_CANDIDATES = 2**20


def nearest_by_tensors(scaled: th.Tensor, points: Points, bounds: Bounds, k: int) -> Neighbors:
    """
    :param scaled: observations in scaled units, shape (batch, obs_dim)
    :param points: the points
    :param bounds: the range that is mapped to [-1, 1]
    :param k: number of neighbours
    :return: the first k by (squared distance, index)
    :raises ValueError: if too many points of a lattice would have to be compared
    """
    ranks = candidate_ranks(points.shape, k) if isinstance(points, Lattice) else None
    if ranks is not None:
        assert isinstance(points, Lattice)
        return _nearest_on_lattice(scaled, points, ranks, k)
    places = points.coordinates(bounds)
    distances = th.zeros_like(scaled[:, :1] * places[:, 0])
    for dimension in range(places.shape[1]):
        distances = distances + (scaled[:, dimension, None] - places[:, dimension]).square()
    indices, nearest = [], []
    for _ in range(k):
        # argmin returns the first of several minima.
        index = distances.argmin(dim=1, keepdim=True)
        indices.append(index)
        nearest.append(distances.gather(1, index))
        distances = distances.scatter(1, index, th.inf)
    return Neighbors(th.cat(indices, dim=1), th.cat(nearest, dim=1))


def _nearest_on_lattice(scaled: th.Tensor, points: Lattice, ranks: np.ndarray, k: int) -> Neighbors:
    total = th.zeros_like(scaled[:, :1])
    number = th.zeros_like(total, dtype=th.int64)
    for dimension, (size, axis) in enumerate(zip(points.shape, points.axis_tensors, strict=True)):
        x = scaled[:, dimension, None]
        # A list: torch warns of tensors that are made of arrays while it traces.
        chosen = ranks[:, dimension].tolist()
        width, reach = window(size, max(chosen))
        first = ((x + 1.0) * (0.5 * (size - 1))).floor() - reach
        near = first.clamp(0, size - width).long() + th.arange(width, device=x.device)
        # A stable order: the lower of two coordinates at one distance comes first.
        squares, order = (x - axis.to(x.device)[near]).square().sort(dim=1, stable=True)
        total = total + squares[:, chosen]
        number = number * size + near.gather(1, order[:, chosen])
    number, by_number = number.sort(dim=1)
    distances, by_distance = total.gather(1, by_number).sort(dim=1, stable=True)
    return Neighbors(number.gather(1, by_distance[:, :k]), distances[:, :k])


def window(size: int, highest_rank: int) -> tuple[int, int]:
    """
    :param size: number of coordinates of a dimension
    :param highest_rank: of a coordinate by its distance from an observation, counted from 0
    :return: the number of neighbouring coordinates that all up to this rank are among, and by how many the first of
        them is below the last coordinate up to the observation, if no end of the dimension is near. One more on either
        side allows for rounding
    """
    return min(size, 2 * highest_rank + 5), highest_rank + 2


@lru_cache(maxsize=16)
def candidate_ranks(shape: tuple[int, ...], k: int) -> np.ndarray | None:
    """
    The points of a lattice that can be among the k nearest of any observation. In each dimension, the coordinates are
    ranked by their distance from the observation. As many points are at least as near as a point as the product, over
    the dimensions, of the number of ranks up to its own. Rounding can blur the order of two neighbouring ranks, which
    lie on either side of the observation, so the rank before its own is not counted.

    :param shape: number of points in each dimension
    :param k: number of neighbours
    :return: ranks in each dimension, counted from 0, shape (n_candidates, obs_dim), int64; ``None`` if that would be no
        fewer than all points
    :raises ValueError: if they are more than :data:`MOST_CANDIDATES`
    """
    n_candidates, n_points = _count_ranks(shape, k), math.prod(shape)
    if n_candidates > MOST_CANDIDATES:
        raise ValueError(
            f"points: with n_neighbors={k}, tensor operations would have to compare {n_candidates:.3g} points of a "
            f"lattice of {len(shape)} dimensions with each observation. Export the policy as 'c', or make it with "
            "fewer neighbours"
        )
    if n_candidates == n_points:
        return None
    return np.array(list(_ranks(shape, k)), dtype=np.int64).reshape(-1, len(shape))


@lru_cache(maxsize=4096)
def _count_ranks(shape: tuple[int, ...], k: int) -> int:
    """The number of :func:`_ranks`."""
    if not shape:
        return 1
    return sum(_count_ranks(shape[1:], k // max(rank, 1)) for rank in range(min(shape[0], k + 1)))


def _ranks(shape: tuple[int, ...], k: int) -> Iterator[tuple[int, ...]]:
    """All ranks, in each dimension, whose product is at most k, where a rank of 0 counts as 1."""
    if not shape:
        yield ()
        return
    for rank in range(min(shape[0], k + 1)):
        for others in _ranks(shape[1:], k // max(rank, 1)):
            yield (rank, *others)
