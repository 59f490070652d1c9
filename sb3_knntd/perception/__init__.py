"""Perception: bounds, points, neighbour search and weights turn an observation into a distribution over points."""

from __future__ import annotations

from sb3_knntd.perception.bounds import Bounds, make_bounds
from sb3_knntd.perception.config import PerceptionConfig, make_perceiver
from sb3_knntd.perception.experience import Experience
from sb3_knntd.perception.growing import GrowingPoints, Growth
from sb3_knntd.perception.perceiver import Perceiver, Perception
from sb3_knntd.perception.points import Lattice, Points, Scattered, make_points
from sb3_knntd.perception.weights import Weights, make_weights

__all__ = [
    "Bounds",
    "Experience",
    "GrowingPoints",
    "Growth",
    "Lattice",
    "Perceiver",
    "Perception",
    "PerceptionConfig",
    "Points",
    "Scattered",
    "Weights",
    "make_bounds",
    "make_perceiver",
    "make_points",
    "make_weights",
]
