"""Exact search on a lattice. Its cost does not depend on the number of points."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_knntd.kernels.nearest import nearest_on_lattice_batch
from sb3_knntd.kernels.perceive import SearchKind
from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search.base import Neighbors, Search, SearchArguments


class LatticeSearch(Search):
    """
    Merges the coordinates of one dimension after the other into a list of the nearest points, on the CPU. It takes
    O(k D r) operations for D dimensions, where r is the number of coordinates of a dimension that are merged at a time.
    See :func:`sb3_knntd.kernels.nearest.nearest_on_lattice`.
    """

    def __init__(self, points: Points, n_neighbors: int) -> None:
        super().__init__(points, n_neighbors)
        if not isinstance(points, Lattice):
            raise ValueError("search='lattice' needs a lattice of points; these are scattered: use 'kd_tree' or 'auto'")
        self._axes = np.concatenate(points.axes)
        self._offsets = np.concatenate(([0], np.cumsum(points.shape))).astype(np.int64)

    def fit(self, bounds: Bounds) -> None:
        """Do nothing: in scaled units a lattice never changes."""

    def query(self, scaled: th.Tensor) -> Neighbors:
        indices = np.empty((len(scaled), self.n_neighbors), np.int64)
        distances = np.empty((len(scaled), self.n_neighbors))
        nearest_on_lattice_batch(scaled.cpu().numpy(), self._axes, self._offsets, self.n_neighbors, indices, distances)
        return Neighbors(th.from_numpy(indices).to(scaled.device), th.from_numpy(distances).to(scaled.device))

    def kernel_arguments(self) -> SearchArguments:
        return SearchArguments(int(SearchKind.LATTICE), axes=self._axes, offsets=self._offsets)
