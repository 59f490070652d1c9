"""One of the points that an explanation is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Neighbor:
    """
    One of the k nearest points of an observation.

    :param index: number of the point, its row in ``policy.points``
    :param point: its place, shape (obs_dim,), observation units
    :param distance: its distance from the observation, scaled units (the range of each dimension has width 2)
    :param probability: its weight, normalised
    :param values: its action values, shape (n_columns,)
    :param visits: number of learning steps that have updated it
    """

    index: int
    point: np.ndarray
    distance: float
    probability: float
    values: np.ndarray
    visits: int
