"""The transitions that a model is learned from."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.common.state_checks import checked_tensor

#: Share of the transitions that are dropped when the buffer is full.
DROPPED = 0.1
#: Number of first observations of episodes that are kept.
MOST_STARTS = 50


class TransitionBuffer:
    """
    Transitions in observation units, and the observations that the last episodes began with.

    :param capacity: largest number of transitions
    :param obs_dim: number of observation dimensions
    :param action_dim: number of numbers in an action, 1 for Discrete
    """

    #: the arrays, and the shape of an entry by the two numbers of dimensions
    _FIELDS = ("observations", "actions", "rewards", "next_observations", "terminated")

    def __init__(self, capacity: int, obs_dim: int, action_dim: int) -> None:
        self.capacity = capacity
        self.obs_dim = obs_dim
        self.action_dim = action_dim
        self.n_transitions = 0
        #: shape (n_starts, obs_dim), the last one last
        self.starts = np.empty((0, obs_dim))
        self._reserve(min(1024, capacity))

    def _reserve(self, size: int) -> None:
        n = self.n_transitions
        shapes = {"observations": (self.obs_dim,), "next_observations": (self.obs_dim,), "actions": (self.action_dim,)}
        for name in self._FIELDS:
            array = np.zeros((size, *shapes.get(name, ())), np.bool_ if name == "terminated" else np.float64)
            if n:
                array[:n] = getattr(self, name)[:n]
            setattr(self, name, array)

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    terminated: np.ndarray

    @property
    def is_full(self) -> bool:
        """Whether transitions must be dropped before another one can be added."""
        return self.n_transitions == self.capacity

    def add(
        self,
        observation: np.ndarray,
        action: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> int:
        """
        :param observation: shape (obs_dim,), observation units
        :param action: shape (action_dim,)
        :param reward: reward of the step
        :param next_observation: shape (obs_dim,), observation units
        :param terminated: whether the next state is terminal
        :return: index of the transition
        """
        i = self.n_transitions
        if i == len(self.rewards):
            self._reserve(min(2 * i, self.capacity))
        self.observations[i] = observation
        self.actions[i] = action
        self.rewards[i] = reward
        self.next_observations[i] = next_observation
        self.terminated[i] = terminated
        self.n_transitions += 1
        return i

    def add_start(self, observation: np.ndarray) -> None:
        """
        :param observation: the first observation of an episode, shape (obs_dim,)
        """
        self.starts = np.concatenate((self.starts, observation[None]))[-MOST_STARTS:]

    def drop(self, uses: np.ndarray) -> np.ndarray:
        """
        Drop a tenth of the transitions: those that are used least; of equal ones, the oldest.

        :param uses: how many local models use each transition, shape (n_transitions,)
        :return: the new index of each transition, -1 for a dropped one, shape (n_before,), int64
        """
        n = self.n_transitions
        order = np.argsort(uses, kind="stable")
        kept = np.sort(order[max(1, int(DROPPED * n)) :])
        renumbered = np.full(n, -1)
        renumbered[kept] = np.arange(len(kept))
        for name in self._FIELDS:
            array = getattr(self, name)
            array[: len(kept)] = array[kept]
        self.n_transitions = len(kept)
        return renumbered

    def state_dict(self) -> dict[str, Any]:
        """
        :return: tensors
        """
        n = self.n_transitions
        state = {name: th.from_numpy(getattr(self, name)[:n].copy()) for name in self._FIELDS}
        return state | {"starts": th.from_numpy(self.starts.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: the return value of :meth:`state_dict`
        :raises ValueError: if it is invalid; the message says why
        """
        n = len(state["rewards"]) if isinstance(state.get("rewards"), th.Tensor) else 0
        if n > self.capacity:
            raise ValueError(f"the buffer holds {n} transitions, more than buffer_size={self.capacity}")
        shapes = {
            "observations": (n, self.obs_dim),
            "next_observations": (n, self.obs_dim),
            "actions": (n, self.action_dim),
        }
        arrays = {}
        for name in self._FIELDS:
            kind = th.bool if name == "terminated" else th.float64
            arrays[name] = checked_tensor(state, name, shapes.get(name, (n,)), kind).numpy()
        starts = checked_tensor(state, "starts", (None, self.obs_dim), th.float64).numpy()
        self.n_transitions = 0
        self._reserve(max(min(1024, self.capacity), n))
        for name, array in arrays.items():
            getattr(self, name)[:n] = array
        self.n_transitions, self.starts = n, starts.copy()
