"""The step as one compiled call over the memory of the torch tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.kernels import step as kernel
from sb3_knntd.kernels.perceive import FOUND
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
        obs_dim, k = perceiver.bounds.obs_dim, perceiver.search.n_neighbors
        self._k = k
        # All that a step brings, in one array: observation, reward, ended, truncated, last observation.
        self._inbox = np.zeros((n_envs, 2 * obs_dim + 3))
        self._observations = self._inbox[:, :obs_dim]
        self._rewards = self._inbox[:, obs_dim]
        self._ended = self._inbox[:, obs_dim + 1]
        self._truncated = self._inbox[:, obs_dim + 2]
        self._last_observations = self._inbox[:, obs_dim + 3 :]
        shape = (3, n_envs, self._k)
        self._states = np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape[:2], np.int64)
        self._sums = np.zeros(2)
        self._n_sums = 0
        self._take_stock()

    def _take_stock(self) -> None:
        """Take up the memory as it is now, and reckon for how many steps there is room in it."""
        self._memory = self.live.memory()
        self._steps_of_room = min(self.live.room, self.table.room) // (self.n_envs * self._k)

    def begin(self, observations: np.ndarray, uniforms: np.ndarray, rates: Rates) -> np.ndarray:
        check_finite("an observation", observations, range(self.n_envs))
        self.live.clear()
        self._take_stock()
        self._observations[:] = observations.reshape(self.n_envs, -1)
        eyes = self.perceiver.kernel_arguments()
        self._find(observations, eyes, kernel.NOW)
        kernel.begin(self._inbox, uniforms, rates.exploration, eyes, self._rule, self._states, self._memory)
        return self._actions()

    def learn(self, transition: Transition, uniforms: np.ndarray, rates: Rates) -> np.ndarray:
        if self._steps_of_room == 0:
            self.table.reserve(self.n_envs * self._k)
            self.live.reserve(self.n_envs * self._k)
            self._take_stock()
        self._steps_of_room -= 1
        self.live.is_published = False
        self._observations[:] = transition.observations.reshape(self._observations.shape)
        self._rewards[:] = transition.rewards
        self._ended[:] = transition.ended
        eyes = self.perceiver.kernel_arguments()
        if eyes[3] == FOUND:
            check_transition(transition)
            self._find(transition.observations, eyes, kernel.THEN)
        truncated = transition.truncated
        if truncated:
            self._truncated[truncated] = 1.0
            self._last_observations[truncated] = transition.last_observations.reshape(len(truncated), -1)
            self._find(transition.last_observations, eyes, kernel.LAST, truncated)
        answer = kernel.learn(
            self._inbox,
            uniforms,
            tuple(rates),
            self._gamma,
            self._form,
            eyes,
            self._rule,
            self._states,
            self._memory,
            self._sums,
        )
        if truncated:
            self._truncated[:] = 0.0
        if answer == kernel.NOT_FINITE:
            check_transition(transition)
        if answer == kernel.DIVERGED:
            raise FloatingPointError(DIVERGENCE)
        self._n_sums += self.n_envs
        return self._actions()

    def _actions(self) -> np.ndarray:
        actions: np.ndarray = self._states[2][kernel.NOW].copy()
        return actions

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
            indices, probabilities, actions = self._states
            indices[kernel.NOW] = state_dict["indices"].numpy()
            probabilities[kernel.NOW] = state_dict["probabilities"].numpy()
            actions[kernel.NOW] = state_dict["entries"][:, 0].numpy()
            self.live.set_state(state_dict["traces"])
        self._take_stock()

    def _find(self, observations: np.ndarray, eyes: tuple[Any, ...], state: int, rows: Any = slice(None)) -> None:
        """Have the neighbours found by a search that the kernel does not have in it."""
        if eyes[3] == FOUND:
            neighbors = self.perceiver.find(th.from_numpy(np.ascontiguousarray(observations)))
            self._states[0][state, rows] = neighbors.indices.numpy()
            self._states[1][state, rows] = neighbors.squared_distances.numpy()
