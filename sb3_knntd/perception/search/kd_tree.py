"""Exact search with SciPy's kd-tree, for scattered points in few dimensions."""

from __future__ import annotations

import numpy as np
import torch as th
from scipy.spatial import cKDTree

from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.search.base import Neighbors, Search, nearest_of_candidates

#: The tree computes distances in another order of operations. It may swap two that differ by less than this fraction.
ROUNDING = 1e-9


class KDTreeSearch(Search):
    """
    The tree proposes k + 1 neighbours, whose distances are computed again in the order of operations that all searches
    share. Where the last two distances are equal up to rounding, all points at that distance become candidates.
    """

    _places: np.ndarray
    _tree: cKDTree

    def fit(self, bounds: Bounds) -> None:
        self._places = self.points.coordinates(bounds).cpu().numpy()
        self._tree = cKDTree(self._places)

    def query(self, scaled: th.Tensor) -> Neighbors:
        queries, k = scaled.cpu().numpy(), self.n_neighbors
        n_proposed = min(k + 1, self.points.n_points)
        distances, proposed = map(np.asarray, self._tree.query(queries, k=n_proposed))
        # SciPy drops the axis of a single neighbour, and returns int32 on some systems.
        distances = distances.reshape(len(queries), n_proposed)
        candidates = proposed.reshape(len(queries), n_proposed).astype(np.int64, copy=False)
        found = nearest_of_candidates(queries, self._places, candidates, k)
        if n_proposed > k:
            for row in (distances[:, k] <= distances[:, k - 1] * (1 + ROUNDING)).nonzero()[0]:
                near = self._tree.query_ball_point(queries[row], distances[row, k] * (1 + ROUNDING))
                again = nearest_of_candidates(queries[row, None], self._places, np.array([near], np.int64), k)
                found.indices[row], found.squared_distances[row] = again.indices[0], again.squared_distances[0]
        return Neighbors(*(column.to(scaled.device) for column in found))
