"""Approximate search in a navigable small-world graph, for very many points in many dimensions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch as th

from sb3_knntd.perception.bounds import Bounds
from sb3_knntd.perception.points import Points
from sb3_knntd.perception.search.base import Neighbors, Search, nearest_of_candidates

if TYPE_CHECKING:
    import voyager

#: Number of links of a point, and of candidates while the graph is built: Voyager's defaults.
LINKS = 12
BUILD_CANDIDATES = 200


class HNSWSearch(Search):
    """
    Voyager's graph (Malkov and Yashunin, Efficient and robust approximate nearest neighbor search using
    hierarchical navigable small world graphs, 2018) proposes k neighbours out of max(48, 3 k) candidates in single
    precision. Their distances are computed again, and ordered as in all searches. It may miss some: with 10⁵ points in
    6 dimensions and k = 16 it finds over 99 % of the true neighbours. One thread builds the graph, so that it is
    reproducible. For 10⁵ points that takes 10 to 20 s.

    :raises ImportError: if Voyager is not installed
    """

    _places: np.ndarray
    _graph: voyager.Index

    def __init__(self, points: Points, n_neighbors: int) -> None:
        super().__init__(points, n_neighbors)
        try:
            import voyager  # noqa: F401
        except ImportError as error:
            raise ImportError("search='hnsw' needs Voyager: pip install 'sb3-knntd[ann]'") from error

    def fit(self, bounds: Bounds) -> None:
        from voyager import Index, Space

        self._places = self.points.coordinates(bounds).cpu().numpy()
        self._graph = Index(
            Space.Euclidean, self.points.obs_dim, M=LINKS, ef_construction=BUILD_CANDIDATES, random_seed=1
        )
        self._graph.add_items(self._places.astype(np.float32), num_threads=1)

    def query(self, scaled: th.Tensor) -> Neighbors:
        queries, k = scaled.cpu().numpy(), self.n_neighbors
        n_candidates = max(48, 3 * k)
        proposed, _ = self._graph.query(queries.astype(np.float32), k, num_threads=1, query_ef=n_candidates)
        # Voyager drops the batch of a single query.
        proposed = np.asarray(proposed, dtype=np.int64).reshape(len(queries), k)
        found = nearest_of_candidates(queries, self._places, proposed, k)
        return Neighbors(*(column.to(scaled.device) for column in found))
