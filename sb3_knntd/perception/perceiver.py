"""From an observation to a distribution over its nearest points."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.tracing import is_traced
from sb3_knntd.kernels.perceive import PerceptionArguments, SearchKind, are_within, first_far, perceive
from sb3_knntd.perception.bounds import FARTHEST, Bounds
from sb3_knntd.perception.growing import GrowingPoints
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
        self._renew()

    def _renew(self) -> None:
        """Make new arguments for the kernels."""
        self._squared_spacing = self.points.squared_spacing
        self.arguments = self._make_arguments()
        self.search_is_outside = self.arguments is not None and self.arguments.search == SearchKind.OUTSIDE
        self.version += 1

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        # A copy's search must share its arrays with the copy's arguments: points are added to them.
        self._renew()

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
            squared_spacing=self._squared_spacing,
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
        if self.search.extend(self.bounds, added) or self.points.squared_spacing != self._squared_spacing:
            self._renew()
        return added

    def find(self, observations: th.Tensor) -> Neighbors:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: their neighbours
        """
        return self.search.query(self.bounds.scale(self._flat(observations)))

    def first_new(self, observations: np.ndarray, first: int = 0) -> int:
        """
        :param observations: shape (batch, obs_dim), any number type, observation units
        :param first: the observation to begin with
        :return: the first observation that lies farther than the spacing from all points, if there is room for one
            more; the length of the batch if there is none
        """
        limit = self._squared_spacing
        if self.arguments is not None and self.arguments.search == SearchKind.ALL_POINTS:
            arguments = self.arguments
            low, width, farthest, columns = arguments.low, arguments.width, arguments.limit, arguments.columns
            return int(first_far(observations, first, low, width, farthest, columns, limit))
        seen = th.from_numpy(observations[first:]).to(self.bounds.low.device)
        far = (self.find(seen).squared_distances[:, 0] > limit).nonzero()
        return first + int(far[0, 0]) if len(far) else len(observations)

    def perceive_one(self, observation: np.ndarray) -> Perception:
        """
        :param observation: shape (obs_dim,), float32 or float64, observation units
        :return: its perception, by the compiled search if possible, which takes a few microseconds
        """
        if self.arguments is None or self.search_is_outside:
            perception: Perception = self(th.from_numpy(observation).to(self.bounds.low.device))
            return perception
        k = self.search.n_neighbors
        indices, probabilities = np.empty((1, k), np.int64), np.empty((1, k))
        perceive(observation, self.arguments, indices[0], probabilities[0])
        return Perception(th.from_numpy(indices), th.from_numpy(probabilities))

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
        :return: whether :meth:`widen` or :meth:`lay_anew` would change nothing: all lie within the bounds that can
            still move, and there is room for more points if they grow
        """
        return not self.points.is_full and bool(are_within(observations.reshape(-1, self.bounds.obs_dim), *self._reach))

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

    def lay_anew(self, observations: th.Tensor) -> th.Tensor | None:
        """
        Scale the open dimensions by the range visited so far, and thin out points that grow.

        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: the new index of each point, of a dropped one that of the remaining point nearest to it, shape
            (n_before,), int64; ``None`` if all points stay
        """
        assert isinstance(self.points, GrowingPoints)
        self.bounds.widen(th.cat((self._flat(observations), self.points.places.to(self.bounds.low))))
        moved = self.points.thin(self.bounds)
        self.fit()
        return moved

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
            if not isinstance(self.points, GrowingPoints):
                weights = self.weights(squared_distances)
                # Added one after the other, as in the kernels, so that both are rounded in the same way.
                return Perception(indices, weights / weights.cumsum(dim=1)[:, -1:])
        else:
            indices, squared_distances = self.search.query(scaled)
        return Perception(indices, self.weigh(squared_distances))

    def weigh(self, squared_distances: th.Tensor) -> th.Tensor:
        """
        :param squared_distances: of the neighbours in ascending order, shape (batch, k), scaled units; infinite where
            there are fewer than k points
        :return: the probabilities of the neighbours, shape (batch, k)
        """
        if isinstance(self.points, GrowingPoints):
            return self._weigh_existing(squared_distances)
        weights = self.weights(squared_distances)
        return weights / weights.sum(dim=1, keepdim=True)

    def _weigh_existing(self, squared_distances: th.Tensor) -> th.Tensor:
        """Like :meth:`weigh`, 0 where there is no point; all the same if there is none at all."""
        is_point = th.isfinite(squared_distances)
        known = th.where(is_point, squared_distances, 0.0)
        weights = self.weights(th.where(is_point, known, known.amax(dim=1, keepdim=True)))
        weights = th.where(is_point | ~is_point.any(dim=1, keepdim=True), weights, 0.0)
        return weights / weights.sum(dim=1, keepdim=True)

    def _flat(self, observations: th.Tensor) -> th.Tensor:
        return observations.reshape(-1, self.bounds.obs_dim).to(self.bounds.low)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        name, k = prefix + "points.places", self.search.n_neighbors
        places = state_dict.get(name)
        grows = isinstance(self.points, GrowingPoints)
        if not grows and isinstance(places, th.Tensor) and places.shape[:1] < (k,):
            raise ValueError(f"{name} must have at least n_neighbors={k} rows; got shape {tuple(places.shape)}")
        super()._load_from_state_dict(state_dict, prefix, *args)
