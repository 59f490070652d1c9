"""The step as one compiled call over the memory of the torch tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.kernels import step as kernel
from sb3_knntd.learner import DIVERGENCE, Form, Learner, Rates, Transition, check_finite, check_transition
from sb3_knntd.memory import LiveStore, QTable
from sb3_knntd.perception import Perceiver
from sb3_knntd.rules import DiscreteRule


class CompiledLearner(Learner):
    """
    The same answers as :class:`~sb3_knntd.learner.TorchLearner`, on the CPU, in microseconds.

    :param perceiver: where am I? With weights that are known to the kernels
    :param table: what is it worth?
    :param rule: what do I do?
    :param n_envs: number of environments
    :param form: which of the update's forms
    """

    def __init__(self, perceiver: Perceiver, table: QTable, rule: DiscreteRule, n_envs: int, form: Form) -> None:
        self.perceiver = perceiver
        self.table = table
        self.n_envs = n_envs
        self.live = LiveStore(table, n_envs)
        self._gamma = float(form.gamma)
        self._form = (form.normalized, form.accumulating, form.reset_other_actions)
        self._rule = rule.kernel_arguments()
        self._obs_dim, self._k = perceiver.bounds.obs_dim, perceiver.search.n_neighbors
        self._truncated = np.zeros(n_envs, np.bool_)
        self._endings = self._truncated, np.zeros((n_envs, self._obs_dim))
        shape = (3, n_envs, self._k)
        self._states = np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape[:2], np.int64)
        self._actions: np.ndarray = self._states[2][kernel.NOW]
        self._sums = np.zeros(2)
        self._n_sums = 0
        self._take_stock()

    def _take_stock(self) -> None:
        """Take up the memory as it is now, and reckon for how many steps there is room in it."""
        self._memory = self.live.memory()
        self._steps_of_room = min(self.live.room, self.table.room) // (self.n_envs * self._k)

    def begin(self, observations: np.ndarray, uniforms: np.ndarray, rate: float) -> np.ndarray:
        check_finite("an observation", observations, range(self.n_envs))
        self.live.clear()
        self._take_stock()
        seen, eyes = self._seen(observations), self.perceiver.eyes
        self._find(seen, kernel.NOW)
        kernel.begin(seen, uniforms, rate, eyes, self._rule, self._states, self._memory)
        return self._actions.copy()

    def learn(self, transition: Transition, uniforms: np.ndarray, rates: Rates) -> np.ndarray:
        observations, rewards, ended, truncated, last_observations = transition
        if self._steps_of_room == 0:
            self.table.reserve(self.n_envs * self._k)
            self.live.reserve(self.n_envs * self._k)
            self._take_stock()
        self._steps_of_room -= 1
        self.live.is_published = False
        seen, eyes = self._seen(observations), self.perceiver.eyes
        if self.perceiver.search_is_outside:
            check_transition(transition)
            self._find(seen, kernel.THEN)
        if truncated:
            self._truncated[truncated] = True
            self._endings[1][truncated] = self._seen(last_observations)
            self._find(self._endings[1][truncated], kernel.LAST, truncated)
        answer = kernel.learn(
            (seen, rewards, ended),
            self._endings,
            uniforms,
            rates,
            self._gamma,
            self._form,
            eyes,
            self._rule,
            self._states,
            self._memory,
            self._sums,
        )
        if truncated:
            self._truncated[:] = False
        if answer == kernel.NOT_FINITE:
            check_transition(transition)
        if answer == kernel.DIVERGED:
            raise FloatingPointError(DIVERGENCE)
        self._n_sums += self.n_envs
        return self._actions.copy()

    def summary(self) -> dict[str, float]:
        if not self._n_sums:
            return {}
        td_error, q_mean = (self._sums / self._n_sums).tolist()
        self._sums[:] = 0.0
        self._n_sums = 0
        return {"td_error": td_error, "q_mean": q_mean}

    def state_dict(self) -> dict[str, Any]:
        indices, probabilities, actions = (th.from_numpy(array[kernel.NOW].copy()) for array in self._states)
        return {
            "indices": indices,
            "probabilities": probabilities,
            "entries": actions[:, None].expand(indices.shape).contiguous(),
            "traces": self.live.state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        self.live.forget()
        if len(state_dict["indices"]) == self.n_envs:
            indices, probabilities, _ = self._states
            indices[kernel.NOW] = state_dict["indices"].numpy()
            probabilities[kernel.NOW] = state_dict["probabilities"].numpy()
            self._actions[:] = state_dict["entries"][:, 0].numpy()
            self.live.set_state(state_dict["traces"])
        self._take_stock()

    def _seen(self, observations: np.ndarray) -> np.ndarray:
        """Observations as the kernel takes them: (batch, obs_dim), in one of two types, so that two are compiled."""
        if observations.dtype != np.float32:
            observations = observations.astype(np.float64, copy=False)
        return observations if observations.ndim == 2 else observations[:, None]

    def _find(self, observations: np.ndarray, state: int, rows: Any = slice(None)) -> None:
        """Have the neighbours found by a search that the kernel does not have in it."""
        if self.perceiver.search_is_outside:
            neighbors = self.perceiver.find(th.from_numpy(observations))
            self._states[0][state, rows] = neighbors.indices.numpy()
            self._states[1][state, rows] = neighbors.squared_distances.numpy()
