"""Exact search by computing all distances: the reference, on any device."""

from __future__ import annotations

import torch as th

from sb3_knntd.kernels.perceive import SearchKind
from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.search.base import Neighbors, Search, SearchArguments

#: Largest number of distances held at once. Larger batches are split.
MAX_DISTANCES = 2**26


class BruteSearch(Search):
    """Computes the distances to all points and takes the first k by (distance, index)."""

    _columns: th.Tensor

    def fit(self, bounds: Bounds) -> None:
        self._columns = self.points.coordinates(bounds).T.contiguous()

    def query(self, scaled: th.Tensor) -> Neighbors:
        rows = max(1, MAX_DISTANCES // self.points.n_points)
        parts = [self._query(chunk) for chunk in scaled.split(rows)]
        return parts[0] if len(parts) == 1 else Neighbors(*(th.cat(column) for column in zip(*parts, strict=True)))

    def kernel_arguments(self) -> SearchArguments:
        return SearchArguments(int(SearchKind.ALL_POINTS), columns=self._columns.numpy())

    def _query(self, scaled: th.Tensor) -> Neighbors:
        # Summed dimension by dimension: th.cdist takes square roots, and matrix products for many rows. Both round, and
        # break the ties that are common on a lattice.
        distances = th.zeros((len(scaled), self.points.n_points), dtype=scaled.dtype, device=scaled.device)
        for dimension, column in enumerate(self._columns):
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
