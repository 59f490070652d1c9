"""The perception points: each is a row of the Q-table."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_knntd.common.checks import check_integer, check_numbers, check_size, shown
from sb3_knntd.common.state_checks import checked_tensor
from sb3_knntd.perception.bounds import Bounds, count_states

#: ``points="auto"``: approximate number of points of the lattice, and the largest number in one dimension.
AUTO_POINTS = 8000
AUTO_POINTS_PER_DIMENSION = 20


class Points(ABC):
    """A set of points, numbered from 0."""

    #: number of points
    n_points: int
    #: number of observation dimensions
    obs_dim: int

    #: whether the points have to be laid anew before another can be added
    is_full = False

    @property
    def n_reserved(self) -> int:
        """Number of points that a search should have room for."""
        return self.n_points

    @property
    def squared_spacing(self) -> float:
        """Squared distance from the nearest point beyond which an observation becomes a point; mostly infinite."""
        return math.inf

    @abstractmethod
    def coordinates(self, bounds: Bounds, indices: th.Tensor | None = None) -> th.Tensor:
        """
        :param bounds: the range that is mapped to [-1, 1]
        :param indices: points, shape (n,), int64; all points by default
        :return: their coordinates in scaled units, shape (n, obs_dim), float64
        """


class Lattice(Points):
    """
    A regular lattice over [-1, 1] in each scaled dimension, including both ends, numbered in C order (the last
    dimension varies fastest). The only point of a dimension is in its middle. Only the axes are stored.

    :param shape: number of points in each dimension
    :raises ValueError: if the points are too many to be numbered, or the axes too large for the memory
    """

    def __init__(self, shape: Sequence[int]) -> None:
        self.shape = tuple(int(n) for n in shape)
        self.obs_dim = len(self.shape)
        self.n_points = math.prod(self.shape)
        if self.n_points > np.iinfo(np.int64).max:
            raise ValueError(
                f"points: a lattice can have up to 2^63 - 1 points; got {self.shape}, which are {self.n_points:.3g}. "
                "Give fewer points a dimension, 1 for dimensions that matter little"
            )
        # The search holds a copy of the axes.
        check_size(
            f"points: the coordinates of a lattice of {self.shape} points",
            2 * 8 * sum(self.shape),
            "give fewer points a dimension, or map a dimension of so many states to fewer",
        )
        self.axes = [np.linspace(-1.0, 1.0, n) if n > 1 else np.zeros(1) for n in self.shape]
        self.axis_tensors = [th.from_numpy(axis) for axis in self.axes]

    def coordinates(self, bounds: Bounds, indices: th.Tensor | None = None) -> th.Tensor:
        device = bounds.low.device
        rest = th.arange(self.n_points, device=device) if indices is None else indices
        columns = []
        for axis, count in zip(reversed(self.axis_tensors), reversed(self.shape), strict=True):
            columns.append(axis.to(device)[rest % count])
            rest = rest // count
        return th.stack(columns[::-1], dim=1)


class Scattered(Points, nn.Module):
    """
    Points at given places, which can be added to. The places are part of the state dict. A state without them, of a
    version that did not save them, leaves the places as they are.

    :param places: shape (n_points, obs_dim), observation units
    """

    places: th.Tensor

    def __init__(self, places: np.ndarray) -> None:
        super().__init__()
        self.register_buffer("places", th.from_numpy(np.array(places, dtype=np.float64)))
        self.n_points, self.obs_dim = self.places.shape

    def append(self, new_points: Any) -> th.Tensor:
        """
        :param new_points: places of the points to add, shape (n, obs_dim), observation units, finite
        :return: the indices of the new points, shape (n,), int64
        :raises ValueError: if the places have another shape, or are not finite numbers
        """
        first = self.n_points
        self._set(th.cat((self.places, th.from_numpy(check_places(new_points, self.obs_dim)).to(self.places))))
        return th.arange(first, self.n_points, device=self.places.device)

    def truncate(self, n_points: int) -> None:
        """
        :param n_points: number of points to keep, the first ones
        """
        self._set(self.places[:n_points])

    def _set(self, places: th.Tensor) -> None:
        self.places, self.n_points = places, len(places)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        name = prefix + "places"
        if name in state_dict:
            # The number of points can differ from that at construction.
            places = checked_tensor(state_dict, name, (None, self.obs_dim))
            self._set(places.to(self.places, copy=True))
        super()._load_from_state_dict({**state_dict, name: self.places}, prefix, *args)

    def coordinates(self, bounds: Bounds, indices: th.Tensor | None = None) -> th.Tensor:
        places = self.places.to(bounds.low.device)
        return bounds.scale(places if indices is None else places[indices])


def make_points(points: Any, observation_space: spaces.Space[Any]) -> Points:
    """
    :param points: ``"auto"``, an int (points in each dimension), one int per dimension, or an array of shape
        (n_points, obs_dim) in observation units
    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :return: the points; one per state unless the space is a Box
    :raises ValueError: if ``points`` does not fit the space
    """
    if isinstance(observation_space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        if not (isinstance(points, str) and points == "auto"):
            raise ValueError(
                f"points must be 'auto' for a {type(observation_space).__name__} observation space, which has one "
                f"point a state; got {shown(points)}"
            )
        return Lattice(count_states(observation_space)[1].tolist())

    assert observation_space.shape is not None
    obs_dim = observation_space.shape[0]
    if isinstance(points, str):
        if points != "auto":
            raise ValueError(
                f"points must be 'auto', 'grow', an int, one int a dimension, or an array; got {shown(points)}"
            )
        per_dimension = min(AUTO_POINTS_PER_DIMENSION, max(2, round(AUTO_POINTS ** (1 / obs_dim))))
        return Lattice((per_dimension,) * obs_dim)

    try:
        array = np.asarray(points)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"points: scattered points must be an array of shape (n_points, {obs_dim}), with rows of one length; got "
            f"{shown(points)}"
        ) from error
    if array.ndim == 0:
        return Lattice((check_integer("points", points, 1),) * obs_dim)
    if array.ndim == 1:
        if len(array) != obs_dim:
            raise ValueError(
                f"points: one int for each of the {obs_dim} observation dimensions is needed; got {len(array)}: "
                f"{shown(points)} (scattered points are an array of shape (n_points, {obs_dim}))"
            )
        return Lattice([check_integer("points", count, 1) for count in array.tolist()])
    return Scattered(check_places(array, obs_dim))


def check_places(points: Any, obs_dim: int) -> np.ndarray:
    """
    :param points: places of scattered points
    :param obs_dim: number of observation dimensions
    :return: the places, shape (n_points, obs_dim), float64
    :raises ValueError: if ``points`` has another shape, is empty, or holds anything but finite numbers
    """
    places = check_numbers("points: finite places", points)
    if places.ndim != 2 or places.shape[1] != obs_dim or len(places) == 0:
        raise ValueError(
            f"points: scattered points must be an array of shape (n_points, {obs_dim}); got shape {places.shape}"
        )
    if not np.isfinite(places).all():
        raise ValueError(f"points: scattered points must be finite numbers; got {shown(points)}")
    return places


def count_neighbors(n_neighbors: Any, observation_space: spaces.Space[Any], n_points: int, obs_dim: int) -> int:
    """
    :param n_neighbors: k, or ``"auto"``: 2 obs_dim + 1, a point and its neighbours along each axis, for a Box, and 1
        otherwise
    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :param n_points: number of points to choose from
    :param obs_dim: number of observation dimensions
    :return: k
    :raises ValueError: if it is not an integer >= 1, or more than the number of points
    """
    exact = not isinstance(observation_space, spaces.Box)
    if isinstance(n_neighbors, str):
        if n_neighbors != "auto":
            raise ValueError(f"n_neighbors must be an integer >= 1, or 'auto'; got {shown(n_neighbors)}")
        return 1 if exact else min(2 * obs_dim + 1, n_points)
    k = check_integer("n_neighbors", n_neighbors, 1)
    if exact and k != 1:
        raise ValueError(
            f"n_neighbors must be 1 or 'auto' for a {type(observation_space).__name__} observation space, whose "
            f"states have no neighbours; got {k}"
        )
    if k > n_points:
        raise ValueError(
            f"n_neighbors must be at most the number of points, {n_points}; got {k}. "
            "Give fewer neighbours or more points"
        )
    return k
