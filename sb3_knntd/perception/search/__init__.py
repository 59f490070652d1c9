"""Searches for the k nearest points. All exact ones return the same."""

from __future__ import annotations

from sb3_knntd.common.checks import check_size, check_word
from sb3_knntd.kernels import jit
from sb3_knntd.perception.growing import GrowingPoints
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search.base import Neighbors, Search, SearchArguments
from sb3_knntd.perception.search.brute import BruteSearch
from sb3_knntd.perception.search.hnsw import HNSWSearch
from sb3_knntd.perception.search.kd_tree import KDTreeSearch
from sb3_knntd.perception.search.lattice import LatticeSearch

__all__ = [
    "SEARCHES",
    "BruteSearch",
    "HNSWSearch",
    "KDTreeSearch",
    "LatticeSearch",
    "Neighbors",
    "Search",
    "SearchArguments",
    "make_search",
]

#: The searches by name.
SEARCHES: dict[str, type[Search]] = {
    "brute": BruteSearch,
    "lattice": LatticeSearch,
    "kd_tree": KDTreeSearch,
    "hnsw": HNSWSearch,
}
#: Up to this many scattered points, computing all distances is faster than a call of SciPy's tree.
FEW_POINTS = 10_000


def make_search(search: str, points: Points, n_neighbors: int) -> Search:
    """
    :param search: name of a search, or ``"auto"``
    :param points: the points to search
    :param n_neighbors: k
    :return: the search
    :raises ValueError: if the name is unknown, or the search cannot be used for these points
    :raises ImportError: if the search needs a library that is not installed
    """
    check_word("search", search, ["auto", *SEARCHES])
    kind = SEARCHES[choose_search(points) if search == "auto" else search]
    if isinstance(points, GrowingPoints) and kind is not BruteSearch:
        raise ValueError(f"search must be 'auto' or 'brute' for points that grow, which change often; got {search!r}")
    if isinstance(points, Lattice) and kind is not LatticeSearch:
        # All coordinates are held twice while they are brought into the order that the search needs.
        check_size(
            f"search={search!r}: a list of {points.n_points} points",
            3 * 8 * points.n_points * points.obs_dim,
            "use 'lattice' or 'auto', or give fewer points",
        )
    return kind(points, n_neighbors)


def choose_search(points: Points) -> str:
    """
    :param points: the points to search
    :return: name of the fastest exact search for them
    """
    if isinstance(points, Lattice) and (jit.AVAILABLE or points.n_points > FEW_POINTS):
        return "lattice"
    few = points.n_points <= FEW_POINTS or points.obs_dim > 12
    return "brute" if few or isinstance(points, GrowingPoints) else "kd_tree"
