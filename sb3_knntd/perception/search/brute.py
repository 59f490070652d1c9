"""Search by computing every distance: the reference, on any device."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.kernels.perceive import ALL
from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.search.base import Neighbors, Search

#: Largest number of distances held at once; more observations than that allows are answered in turns.
MAX_DISTANCES = 2**26


class BruteSearch(Search):
    """Distances to all points, the k smallest by (distance, index)."""

    _columns: th.Tensor

    def fit(self, bounds: Bounds) -> None:
        self._columns = self.points.coordinates(bounds).T.contiguous()

    def query(self, scaled: th.Tensor) -> Neighbors:
        rows = max(1, MAX_DISTANCES // self.points.n_points)
        parts = [self._query(chunk) for chunk in scaled.split(rows)]
        return parts[0] if len(parts) == 1 else Neighbors(*(th.cat(column) for column in zip(*parts, strict=True)))

    def kernel_arguments(self) -> tuple[Any, ...]:
        return ALL, np.empty(0), np.empty(0, np.int64), self._columns.numpy()

    def _query(self, scaled: th.Tensor) -> Neighbors:
        # Summed dimension by dimension: th.cdist takes a matrix product for many rows, and a root for
        # all, and either one blurs ties, which a lattice is full of.
        distances = th.zeros((len(scaled), self.points.n_points), dtype=scaled.dtype, device=scaled.device)
        for dimension, column in enumerate(self._columns):
            distances += (scaled[:, dimension, None] - column).square_()
        return smallest(distances, self.n_neighbors)


def smallest(distances: th.Tensor, k: int) -> Neighbors:
    """
    The k smallest of each row, sorted by (value, index). ``topk`` alone promises no order among equals.

    :param distances: shape (batch, n)
    :param k: how many, at most n
    :return: their indices and values, shape (batch, k)
    """
    limit = distances.topk(k, dim=1, largest=False).values[:, -1:]
    nearer = distances < limit
    tied = distances == limit
    vacancies = k - nearer.sum(dim=1, keepdim=True)
    chosen = nearer | (tied & (tied.cumsum(dim=1) <= vacancies))
    # Exactly k a row are chosen; ranking them by index alone leaves topk no equals to order.
    n = distances.shape[1]
    by_index = th.where(chosen, th.arange(n, 0, -1, device=distances.device), 0)
    indices = n - by_index.topk(k, dim=1).values
    values, order = distances.gather(1, indices).sort(dim=1, stable=True)
    return Neighbors(indices.gather(1, order), values)
