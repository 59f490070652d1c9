"""Where am I? Bounds, points, neighbour search and weights make an observation a perception."""

from __future__ import annotations

from sb3_knntd.perception.bounds import Bounds, make_bounds
from sb3_knntd.perception.perceiver import Perceiver, Perception
from sb3_knntd.perception.points import Lattice, Points, Scattered, make_points
from sb3_knntd.perception.weights import Weights, make_weights

__all__ = [
    "Bounds",
    "Lattice",
    "Perceiver",
    "Perception",
    "Points",
    "Scattered",
    "Weights",
    "make_bounds",
    "make_points",
    "make_weights",
]
