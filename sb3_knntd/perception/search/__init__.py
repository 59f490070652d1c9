"""How the k nearest points are found: one file a search, all with the same answer."""

from __future__ import annotations

from sb3_knntd.checks import check_word
from sb3_knntd.kernels import jit
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search.base import Neighbors, Search
from sb3_knntd.perception.search.brute import BruteSearch
from sb3_knntd.perception.search.lattice import LatticeSearch

__all__ = ["SEARCHES", "BruteSearch", "LatticeSearch", "Neighbors", "Search", "make_search"]

#: Every search by its name.
SEARCHES: dict[str, type[Search]] = {"brute": BruteSearch, "lattice": LatticeSearch}


def make_search(search: str, points: Points, n_neighbors: int) -> Search:
    """
    :param search: name of a search, or ``"auto"``
    :param points: the points to search
    :param n_neighbors: k
    :return: the search
    :raises ValueError: if the name is unknown, or the search cannot be used for these points
    """
    check_word("search", search, ["auto", *SEARCHES])
    if search == "auto":
        search = "lattice" if isinstance(points, Lattice) and jit.AVAILABLE else "brute"
    return SEARCHES[search](points, n_neighbors)
