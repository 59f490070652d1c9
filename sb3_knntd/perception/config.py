"""The settings of perception, and the perceiver that they describe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch as th
from gymnasium import spaces

from sb3_knntd.perception.bounds import make_bounds
from sb3_knntd.perception.growing import GrowingPoints, Growth
from sb3_knntd.perception.perceiver import Perceiver
from sb3_knntd.perception.points import Points, count_neighbors, make_points
from sb3_knntd.perception.search import make_search
from sb3_knntd.perception.weights import make_weights


@dataclass(frozen=True)
class PerceptionConfig:
    """
    The settings of perception as the user gives them. :func:`make_perceiver` checks them.

    :param n_neighbors: see :func:`~sb3_knntd.perception.points.count_neighbors`
    :param points: a :class:`Growth`, or see :func:`~sb3_knntd.perception.make_points`
    :param bounds: see :func:`~sb3_knntd.perception.make_bounds`
    :param weights: see :func:`~sb3_knntd.perception.make_weights`
    :param bandwidth: h, scaled units
    :param search: name of a neighbour search, or ``"auto"``
    """

    n_neighbors: int | str = "auto"
    points: Any = "auto"
    bounds: Any = None
    weights: str | Callable[[th.Tensor], Any] = "inverse_quadratic"
    bandwidth: float = 1.0
    search: str = "auto"


def make_perceiver(
    config: PerceptionConfig, observation_space: spaces.Space[Any], *, bounds_from_space: bool = True
) -> Perceiver:
    """
    :param config: the settings
    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :param bounds_from_space: whether the bounds of the space hold, see :func:`~sb3_knntd.perception.make_bounds`
    :return: the perceiver
    :raises ValueError: if a setting is wrong, or does not fit the space; the message names it
    :raises ImportError: if the search needs a library that is not installed
    """
    grows = isinstance(config.points, Growth)
    if isinstance(config.points, Growth) and isinstance(observation_space, spaces.Box):
        points: Points = config.points.make_points(observation_space.shape[0])
    else:
        points = make_points("grow" if grows else config.points, observation_space)
    most = points.max_points if isinstance(points, GrowingPoints) else points.n_points
    n_neighbors = count_neighbors(config.n_neighbors, observation_space, most, points.obs_dim)
    return Perceiver(
        make_bounds(config.bounds, observation_space, from_space=bounds_from_space, visited=grows),
        points,
        make_search(config.search, points, n_neighbors),
        make_weights(config.weights, config.bandwidth, n_neighbors),
    )
