"""Search on a lattice, at a cost that does not depend on the number of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.kernels.nearest import nearest_on_lattice_batch
from sb3_knntd.kernels.perceive import LATTICE
from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search.base import Neighbors, Search


class LatticeSearch(Search):
    """
    Merges the coordinates of one dimension after the other into a list of the nearest points: O(k D r) for D
    dimensions, of each of which up to r coordinates are at a time in question, exact, on the CPU. See
    :func:`sb3_knntd.kernels.nearest.nearest_on_lattice`.
    """

    def __init__(self, points: Points, n_neighbors: int) -> None:
        super().__init__(points, n_neighbors)
        if not isinstance(points, Lattice):
            raise ValueError("search='lattice' needs a lattice of points; these are scattered: use 'kd_tree' or 'auto'")
        self._axes = np.concatenate(points.axes)
        self._offsets = np.concatenate(([0], np.cumsum(points.shape))).astype(np.int64)

    def fit(self, bounds: Bounds) -> None:
        """Nothing to do: a lattice moves with the bounds."""

    def query(self, scaled: th.Tensor) -> Neighbors:
        indices = np.empty((len(scaled), self.n_neighbors), np.int64)
        distances = np.empty((len(scaled), self.n_neighbors))
        nearest_on_lattice_batch(scaled.cpu().numpy(), self._axes, self._offsets, self.n_neighbors, indices, distances)
        return Neighbors(th.from_numpy(indices).to(scaled.device), th.from_numpy(distances).to(scaled.device))

    def kernel_arguments(self) -> tuple[Any, ...]:
        return LATTICE, self._axes, self._offsets, np.empty((0, 0))
