"""From an observation to a distribution over its nearest points."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.tracing import is_traced
from sb3_knntd.kernels.perceive import PerceptionArguments, SearchKind, are_within
from sb3_knntd.perception.bounds import FARTHEST, Bounds
from sb3_knntd.perception.points import Lattice, Points, Scattered
from sb3_knntd.perception.search import Neighbors, Search
from sb3_knntd.perception.search.tensors import nearest_by_tensors
from sb3_knntd.perception.weights import KernelWeights, Weights


class Perception(NamedTuple):
    """
    The nearest points of each observation and their probabilities (eqs. 5 and 6 of the paper).

    :param indices: the k nearest points, nearest first, shape (batch, k), int64
    :param probabilities: their probabilities, rows sum to 1, shape (batch, k), float64
    """

    indices: th.Tensor
    probabilities: th.Tensor


class Regridding:
    """
    A lattice before and after its bounds were widened.

    :param perceiver: the perceiver with the new bounds
    :param before: the old bounds
    """

    def __init__(self, perceiver: Perceiver, before: Bounds) -> None:
        self._perceiver = perceiver
        self._before = before

    def sources(self, indices: th.Tensor) -> Perception:
        """
        :param indices: points, shape (n,), int64
        :return: the perception, with the old bounds, of an observation at the new place of each point. The mean of a
            function of the points over it is the value to give to that point
        """
        after = self._perceiver.bounds
        places = after.unscale(self._perceiver.points.coordinates(after, indices))
        return self._perceiver.perceive_scaled(self._before.scale(places))

    def targets(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, shape (n,), int64
        :return: the point whose new place is nearest to the old place of each, shape (n,), int64
        """
        places = self._before.unscale(self._perceiver.points.coordinates(self._before, indices))
        return self._perceiver.perceive_scaled(self._perceiver.bounds.scale(places)).indices[:, 0]


class Perceiver(nn.Module):
    """
    Observation -> Bounds -> Search -> Weights -> Perception.

    :param bounds: the range that is mapped to [-1, 1]
    :param points: the points
    :param search: finds the nearest of ``points``
    :param weights: weights the neighbours by distance
    """

    #: arguments of the kernels; ``None`` where they cannot be used: on an accelerator, or if the weights are a function
    arguments: PerceptionArguments | None
    #: whether the neighbours have to be found before a kernel is called
    search_is_outside: bool
    #: increases with each :meth:`fit`: whoever holds ``arguments`` has to take the new ones
    version: int

    def __init__(self, bounds: Bounds, points: Points, search: Search, weights: Weights) -> None:
        super().__init__()
        self.bounds = bounds
        self.points = points
        self.search = search
        self.weights = weights
        self.version = 0
        self.fit()

    def fit(self) -> None:
        """Update what depends on the bounds, their device and the points. Has to be called when one of them changed."""
        self.search.fit(self.bounds)
        self._reach = [bound.cpu().numpy() for bound in self.bounds.reach()]
        self.arguments = self._make_arguments()
        self.search_is_outside = self.arguments is not None and self.arguments.search == SearchKind.OUTSIDE
        self.version += 1

    def _make_arguments(self) -> PerceptionArguments | None:
        if not isinstance(self.weights, KernelWeights) or not self.bounds.low.is_cpu:
            return None
        low, high = self.bounds.low.numpy(), self.bounds.high.numpy()
        return PerceptionArguments(
            low=low,
            width=high - low,
            limit=FARTHEST,
            weighting=int(self.weights.WEIGHTING),
            bandwidth=self.weights.bandwidth,
            **self.search.kernel_arguments()._asdict(),
        )

    def add_points(self, points: Any) -> th.Tensor:
        """
        Add points to scattered ones. The Q-table needs a row for each.

        :param points: places of the new points, shape (n, obs_dim), observation units, finite
        :return: the indices of the new points, shape (n,), int64
        :raises ValueError: if the points form a lattice, or the places have another shape or are not finite
        """
        if not isinstance(self.points, Scattered):
            raise ValueError(
                "points can be added to scattered points only; these form a lattice. Give points as an array of shape "
                f"(n_points, {self.points.obs_dim})"
            )
        added = self.points.append(points)
        self.fit()
        return added

    def find(self, observations: th.Tensor) -> Neighbors:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: their neighbours
        """
        return self.search.query(self.bounds.scale(self._flat(observations)))

    def measure(self, observations: th.Tensor) -> None:
        """
        Widen the bounds of the open dimensions to include these observations.

        :param observations: shape (batch, *obs_shape), any number type
        """
        self.bounds.measure(self._flat(observations))
        self.fit()

    def sees(self, observations: np.ndarray) -> bool:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: whether :meth:`widen` would change nothing: all lie within the bounds that can still move
        """
        return bool(are_within(observations.reshape(-1, self.bounds.obs_dim), *self._reach))

    def widen(self, observations: th.Tensor) -> Regridding | None:
        """
        Widen adaptive bounds to include these observations.

        :param observations: shape (batch, *obs_shape), any number type
        :return: the old and new places of the points; ``None`` for scattered points, which do not move
        """
        before = copy.deepcopy(self.bounds)
        self.bounds.widen(self._flat(observations))
        self.fit()
        return Regridding(self, before) if isinstance(self.points, Lattice) else None

    def forward(self, observations: th.Tensor) -> Perception:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: their perceptions
        """
        return self.perceive_scaled(self.bounds.scale(self._flat(observations)))

    def perceive_scaled(self, scaled: th.Tensor) -> Perception:
        """
        :param scaled: observations, shape (batch, obs_dim), scaled units
        :return: their perceptions
        """
        if is_traced():
            indices, squared_distances = nearest_by_tensors(scaled, self.points, self.bounds, self.search.n_neighbors)
            weights = self.weights(squared_distances)
            # Added one after the other, as in the kernels, so that both are rounded in the same way.
            return Perception(indices, weights / weights.cumsum(dim=1)[:, -1:])
        indices, squared_distances = self.search.query(scaled)
        weights = self.weights(squared_distances)
        return Perception(indices, weights / weights.sum(dim=1, keepdim=True))

    def _flat(self, observations: th.Tensor) -> th.Tensor:
        return observations.reshape(-1, self.bounds.obs_dim).to(self.bounds.low)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        name, k = prefix + "points.places", self.search.n_neighbors
        places = state_dict.get(name)
        if isinstance(places, th.Tensor) and places.shape[:1] < (k,):
            raise ValueError(f"{name} must have at least n_neighbors={k} rows; got shape {tuple(places.shape)}")
        super()._load_from_state_dict(state_dict, prefix, *args)
