"""How the k nearest points are found: one file a search, all with the same answer."""

from __future__ import annotations

from sb3_knntd.common.checks import check_size, check_word
from sb3_knntd.kernels import jit
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search.base import Neighbors, Search
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
    "make_search",
]

#: Every search by its name.
SEARCHES: dict[str, type[Search]] = {
    "brute": BruteSearch,
    "lattice": LatticeSearch,
    "kd_tree": KDTreeSearch,
    "hnsw": HNSWSearch,
}
#: So many scattered points are searched through sooner than SciPy is called.
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
    if isinstance(points, Lattice) and kind is not LatticeSearch:
        # Each point has its place, once while they are put together and once in the order that the search needs.
        check_size(
            f"search={search!r}: a list of {points.n_points} points",
            3 * 8 * points.n_points * points.obs_dim,
            "use 'lattice' or 'auto', or give fewer points",
        )
    return kind(points, n_neighbors)


def choose_search(points: Points) -> str:
    """
    :param points: the points to search
    :return: name of the exact search that is fastest for them
    """
    if isinstance(points, Lattice) and (jit.AVAILABLE or points.n_points > FEW_POINTS):
        return "lattice"
    return "brute" if points.n_points <= FEW_POINTS or points.obs_dim > 12 else "kd_tree"
