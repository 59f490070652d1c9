"""How the k nearest points are found: one file a search, all with the same answer."""

from __future__ import annotations

from sb3_knntd.checks import check_word
from sb3_knntd.perception.points import Points
from sb3_knntd.perception.search.base import Neighbors, Search
from sb3_knntd.perception.search.brute import BruteSearch

__all__ = ["SEARCHES", "BruteSearch", "Neighbors", "Search", "make_search"]

#: Every search by its name.
SEARCHES: dict[str, type[Search]] = {"brute": BruteSearch}


def make_search(search: str, points: Points, n_neighbors: int) -> Search:
    """
    :param search: name of a search, or ``"auto"``
    :param points: the points to search
    :param n_neighbors: k
    :return: the search
    :raises ValueError: if the name is unknown
    """
    check_word("search", search, ["auto", *SEARCHES])
    return SEARCHES["brute" if search == "auto" else search](points, n_neighbors)
