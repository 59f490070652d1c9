"""The policy: perception and table, and the action they recommend."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_knntd.checks import check_integer, check_number, check_word
from sb3_knntd.memory import QTable
from sb3_knntd.perception import Perceiver, Perception, make_bounds, make_points, make_weights
from sb3_knntd.perception.search import make_search
from sb3_knntd.rules import greedy, mean_rows

#: ``n_neighbors="auto"``: so many for each observation dimension, as far as there are points.
AUTO_NEIGHBORS_PER_DIMENSION = 4


class KNNPolicy(BasePolicy):
    """
    A table of action values at points of the observation space, read as a weighted mean over the k nearest.

    :param observation_space: Box of shape (obs_dim,), Discrete or MultiDiscrete
    :param action_space: Discrete
    :param lr_schedule: not used, there is nothing to optimise; part of SB3's signature
    :param n_neighbors: k, or ``"auto"``: 4 for each observation dimension, 1 for Discrete and MultiDiscrete
    :param points: ``"auto"``, an int, one int a dimension, or an array (n_points, obs_dim) in observation units
    :param bounds: ``None`` or (low, high), arrays of shape (obs_dim,) in observation units
    :param weights: ``"inverse_quadratic"``, ``"gaussian"`` or a function from squared distances (batch, k) to
        weights (batch, k)
    :param bandwidth: h of the weights, scaled units
    :param search: how neighbours are found
    :param initial_value: what every entry of the table is at the start
    :param dtype: floating type of the table, ``torch.float64`` or ``torch.float32``
    :param bounds_from_space: whether the observation space tells the range of the observations
    :raises ValueError: if an argument does not fit; the message says which, and what would
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule | None = None,
        n_neighbors: int | str = "auto",
        points: Any = "auto",
        bounds: Any = None,
        weights: str | Callable[[th.Tensor], Any] = "inverse_quadratic",
        bandwidth: float = 1.0,
        search: str = "auto",
        initial_value: float = 0.0,
        dtype: th.dtype = th.float64,
        bounds_from_space: bool = True,
    ) -> None:
        super().__init__(observation_space, action_space)
        check_number("initial_value", initial_value)
        if dtype not in (th.float32, th.float64):
            raise ValueError(f"policy_kwargs: dtype must be torch.float64 or torch.float32; got {dtype!r}")
        self._arguments = {
            "n_neighbors": n_neighbors,
            "points": points,
            "bounds": bounds,
            "weights": weights,
            "bandwidth": bandwidth,
            "search": search,
            "initial_value": initial_value,
            "dtype": dtype,
            "bounds_from_space": bounds_from_space,
        }
        places = make_points(points, observation_space)
        self.n_neighbors = _count_neighbors(n_neighbors, observation_space, places.n_points, places.obs_dim)
        self.perceiver = Perceiver(
            make_bounds(bounds, observation_space, from_space=bounds_from_space),
            places,
            make_search(search, places, self.n_neighbors),
            make_weights(weights, bandwidth, self.n_neighbors),
        )
        self.table = QTable(places.n_points, self._count_actions(), initial_value, dtype)

    def _count_actions(self) -> int:
        assert isinstance(self.action_space, spaces.Discrete)
        return int(self.action_space.n)

    @property
    def device(self) -> th.device:
        """Where the table is."""
        return self.table.values.device

    @property
    def points(self) -> th.Tensor:
        """
        The perception points, shape (n_points, obs_dim), observation units. Until ``learn`` has measured
        them, dimensions without a range of their own stand at [-1, 1].
        """
        bounds = self.perceiver.bounds
        return bounds.unscale(self.perceiver.points.coordinates(bounds))

    @property
    def q_table(self) -> th.Tensor:
        """The action values at the points, shape (n_points, n_actions)."""
        return self.table.values

    def perceive(self, observation: np.ndarray | th.Tensor) -> Perception:
        """
        :param observation: one observation, or a batch, observation units
        :return: its nearest points and how much each counts; one row for a single observation
        """
        return self._perceive(self.obs_to_tensor(_to_numpy(observation))[0])

    def q_values(self, observation: np.ndarray | th.Tensor) -> th.Tensor:
        """
        :param observation: one observation, or a batch, observation units
        :return: Q(s, ·) = Σ p(i) Q(i, ·) (eq. 8), shape (batch, n_actions)
        """
        return mean_rows(*self._rows(self.obs_to_tensor(_to_numpy(observation))[0]))

    def forward(self, observation: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        :param observation: shape (batch, *obs_shape)
        :param deterministic: has no effect: the table's recommendation involves no chance
        :return: actions, shape (batch,)
        """
        return self._predict(observation, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        assert isinstance(self.action_space, spaces.Discrete)
        return greedy(mean_rows(*self._rows(observation))) + int(self.action_space.start)

    def _perceive(self, observations: th.Tensor) -> Perception:
        if not th.isfinite(observations).all():
            raise ValueError(f"observation must be finite; got {observations.tolist()}")
        perception: Perception = self.perceiver(observations)
        return perception

    def _rows(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        perception = self._perceive(observations)
        return self.table.rows(perception.indices), perception.probabilities.to(self.table.values.dtype)

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> KNNPolicy:
        super()._apply(fn, recurse)
        self.perceiver.fit()
        return self

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        answer = super().load_state_dict(state_dict, strict, assign)
        # Saved bounds may differ from those of the space, where they were measured.
        self.perceiver.fit()
        return answer

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            **self._arguments,
        }


def _count_neighbors(n_neighbors: Any, observation_space: spaces.Space[Any], n_points: int, obs_dim: int) -> int:
    exact = not isinstance(observation_space, spaces.Box)
    if isinstance(n_neighbors, str):
        check_word("n_neighbors", n_neighbors, ["auto"])
        return 1 if exact else min(AUTO_NEIGHBORS_PER_DIMENSION * obs_dim, n_points)
    n_neighbors = check_integer("n_neighbors", n_neighbors, 1)
    if exact and n_neighbors != 1:
        raise ValueError(
            f"n_neighbors must be 1 or 'auto' for a {type(observation_space).__name__} observation space, whose "
            f"states have no neighbours; got {n_neighbors}"
        )
    if n_neighbors > n_points:
        raise ValueError(
            f"n_neighbors must be at most the number of points, {n_points}; got {n_neighbors}. "
            "Give fewer neighbours or more points"
        )
    return n_neighbors


def _to_numpy(observation: np.ndarray | th.Tensor) -> np.ndarray:
    return observation.cpu().numpy() if isinstance(observation, th.Tensor) else np.asarray(observation)
