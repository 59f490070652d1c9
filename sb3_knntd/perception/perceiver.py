"""Where am I? From an observation to a distribution over its nearest points."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.tracing import is_traced
from sb3_knntd.kernels.perceive import FOUND, are_within
from sb3_knntd.perception.bounds import FARTHEST, Bounds
from sb3_knntd.perception.points import Lattice, Points
from sb3_knntd.perception.search import Neighbors, Search
from sb3_knntd.perception.search.base import nearest_by_tensors
from sb3_knntd.perception.weights import KernelWeights, Weights


class Perception(NamedTuple):
    """
    What an observation is to the learner (eqs. 5 and 6 of the paper).

    :param indices: the k nearest points, nearest first, shape (batch, k), int64
    :param probabilities: how much each counts, rows sum to 1, shape (batch, k), float64
    """

    indices: th.Tensor
    probabilities: th.Tensor


class Regridding:
    """
    A lattice before and after its bounds were widened.

    :param perceiver: as it is now
    :param before: the bounds as they were
    """

    def __init__(self, perceiver: Perceiver, before: Bounds) -> None:
        self._perceiver = perceiver
        self._before = before

    def sources(self, indices: th.Tensor) -> Perception:
        """
        :param indices: points, shape (n,), int64
        :return: what an observation at the place where each now is would have been before: a function of the
            observations is carried over by giving each point the value that the function had there
        """
        after = self._perceiver.bounds
        places = after.unscale(self._perceiver.points.coordinates(after, indices))
        return self._perceiver.perceive_scaled(self._before.scale(places))

    def targets(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, shape (n,), int64
        :return: the point that is now nearest to the place where each was, shape (n,), int64
        """
        places = self._before.unscale(self._perceiver.points.coordinates(self._before, indices))
        return self._perceiver.perceive_scaled(self._perceiver.bounds.scale(places)).indices[:, 0]


class Perceiver(nn.Module):
    """
    Observation -> Bounds -> Search -> Weights -> Perception.

    :param bounds: the range that is mapped to [-1, 1]
    :param points: the points
    :param search: finds the neighbours among ``points``
    :param weights: weighs them by distance
    """

    #: ``eyes`` of :func:`sb3_knntd.kernels.perceive.perceive`; ``None`` on an accelerator or with weights that are a
    #: function, where no kernel can be used
    eyes: tuple[Any, ...] | None
    #: whether neighbours have to be found before a kernel is called
    search_is_outside: bool

    def __init__(self, bounds: Bounds, points: Points, search: Search, weights: Weights) -> None:
        super().__init__()
        self.bounds = bounds
        self.points = points
        self.search = search
        self.weights = weights
        self.fit()

    def fit(self) -> None:
        """Bring the search up to date with the bounds and their device."""
        self.search.fit(self.bounds)
        self._reach = [bound.cpu().numpy() for bound in self.bounds.reach()]
        self.eyes = self._make_eyes()
        self.search_is_outside = self.eyes is not None and self.eyes[3] == FOUND

    def _make_eyes(self) -> tuple[Any, ...] | None:
        if not isinstance(self.weights, KernelWeights) or not self.bounds.low.is_cpu:
            return None
        low, high = self.bounds.low.numpy(), self.bounds.high.numpy()
        weights = (self.weights.KERNEL, self.weights.bandwidth)
        return (low, high - low, FARTHEST, *self.search.kernel_arguments(), *weights)

    def find(self, observations: th.Tensor) -> Neighbors:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: their neighbours
        """
        return self.search.query(self.bounds.scale(self._flat(observations)))

    def measure(self, observations: th.Tensor) -> None:
        """
        Widen the bounds of the open dimensions to take in these observations.

        :param observations: shape (batch, *obs_shape), any number type
        """
        self.bounds.measure(self._flat(observations))
        self.fit()

    def sees(self, observations: np.ndarray) -> bool:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: whether there is nothing to :meth:`widen`: all lie within the bounds, or beyond those that cannot move
        """
        return bool(are_within(observations.reshape(-1, self.bounds.obs_dim), *self._reach))

    def widen(self, observations: th.Tensor) -> Regridding | None:
        """
        Widen adaptive bounds to take in these observations.

        :param observations: shape (batch, *obs_shape), any number type
        :return: where the points were and are; ``None`` if they are scattered, and have stayed where they were
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
            places = self.points.coordinates(self.bounds)
            indices, squared_distances = nearest_by_tensors(scaled, places, self.search.n_neighbors)
        else:
            indices, squared_distances = self.search.query(scaled)
        weights = self.weights(squared_distances)
        return Perception(indices, weights / weights.sum(dim=1, keepdim=True))

    def _flat(self, observations: th.Tensor) -> th.Tensor:
        return observations.reshape(-1, self.bounds.obs_dim).to(self.bounds.low)
