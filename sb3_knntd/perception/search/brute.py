"""Exact search by computing all distances: the reference, on any device."""

from __future__ import annotations

import torch as th

from sb3_knntd.kernels.perceive import SearchKind
from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.search.base import Neighbors, Search, SearchArguments

#: Largest number of distances held at once. Larger batches are split.
MAX_DISTANCES = 2**26


class BruteSearch(Search):
    """
    Computes the distances to all points and takes the first k by (distance, index). If the points are fewer than k,
    places without a point follow them, at an infinite distance.
    """

    #: coordinates of the points, and infinite ones in room for more, shape (obs_dim, n_points or more)
    _columns: th.Tensor

    def fit(self, bounds: Bounds) -> None:
        columns = self.points.coordinates(bounds).T
        n_columns = max(self.points.n_reserved, self.n_neighbors)
        self._columns = columns.new_full((self.points.obs_dim, n_columns), th.inf)
        self._columns[:, : self.points.n_points] = columns

    def extend(self, bounds: Bounds, added: th.Tensor) -> bool:
        if self.points.n_points > self._columns.shape[1]:
            return super().extend(bounds, added)
        self._columns[:, added] = self.points.coordinates(bounds, added).T
        return False

    def query(self, scaled: th.Tensor) -> Neighbors:
        # Another thread may replace them.
        columns = self._columns
        rows = max(1, MAX_DISTANCES // columns.shape[1])
        parts = [self._query(chunk, columns) for chunk in scaled.split(rows)]
        return parts[0] if len(parts) == 1 else Neighbors(*(th.cat(column) for column in zip(*parts, strict=True)))

    def kernel_arguments(self) -> SearchArguments:
        return SearchArguments(int(SearchKind.ALL_POINTS), columns=self._columns.numpy())

    def _query(self, scaled: th.Tensor, columns: th.Tensor) -> Neighbors:
        # Summed dimension by dimension: th.cdist takes square roots, and matrix products for many rows. Both round, and
        # break the ties that are common on a lattice.
        distances = th.zeros((len(scaled), columns.shape[1]), dtype=scaled.dtype, device=scaled.device)
        for dimension, column in enumerate(columns):
            distances += (scaled[:, dimension, None] - column).square_()
        return smallest(distances, self.n_neighbors)


def smallest(distances: th.Tensor, k: int) -> Neighbors:
    """
    The k smallest of each row, sorted by (value, index). ``topk`` alone does not order equal values.

    :param distances: shape (batch, n)
    :param k: number of values, at most n
    :return: their indices and values, shape (batch, k)
    """
    limit = distances.topk(k, dim=1, largest=False).values[:, -1:]
    nearer = distances < limit
    tied = distances == limit
    vacancies = k - nearer.sum(dim=1, keepdim=True)
    chosen = nearer | (tied & (tied.cumsum(dim=1) <= vacancies))
    # Exactly k per row are chosen. Their indices differ, so topk orders them by index.
    n = distances.shape[1]
    by_index = th.where(chosen, th.arange(n, 0, -1, device=distances.device), 0)
    indices = n - by_index.topk(k, dim=1).values
    values, order = distances.gather(1, indices).sort(dim=1, stable=True)
    return Neighbors(indices.gather(1, order), values)
