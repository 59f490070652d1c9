"""The step as one compiled call over the memory of the torch tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th

from sb3_knntd.actions.selection import ActionRule
from sb3_knntd.common.checks import check_finite
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.kernels import step as kernel
from sb3_knntd.kernels.desk import set_desk
from sb3_knntd.kernels.step import FINE, FULL, USED_UP
from sb3_knntd.learners.base import DIVERGENCE, Form, Learner, Rates, check_transition
from sb3_knntd.perception import Perceiver
from sb3_knntd.q_table import LiveStore, QTable

FLOAT32 = np.dtype(np.float32)
#: What holds addresses of arrays, or looks into them: a copy of the learner makes its own.
OF_THE_DESK = {"_lent", "_desk", "_learn", "_actions"}


class CompiledLearner(Learner):
    """
    The same answers as :class:`~sb3_knntd.learners.base.TorchLearner`, on the CPU, in microseconds.

    :param perceiver: where am I? With weights that are known to the kernels
    :param table: what is it worth?
    :param rule: what do I do?
    :param stream: rows of random numbers, shape (n_envs, 2, rule.n_uniforms)
    :param n_envs: number of environments
    :param form: which of the update's forms
    """

    def __init__(
        self, perceiver: Perceiver, table: QTable, rule: ActionRule, stream: RandomStream, n_envs: int, form: Form
    ) -> None:
        self.perceiver = perceiver
        self.table = table
        self.stream = stream
        self.n_envs = n_envs
        self.live = LiveStore(table, n_envs)
        self._rule = rule.kernel_arguments()
        self._form = tuple(form)
        k, obs_dim = perceiver.search.n_neighbors, perceiver.bounds.obs_dim
        self._indices = np.zeros((3, n_envs, k), np.int64)
        self._probabilities = np.zeros((3, n_envs, k))
        n_blocks = len(rule.blocks) - 1
        self._entries = np.zeros((3, n_envs, k, n_blocks), np.int64)
        self.shape = n_envs, k, n_blocks
        self._held = np.full((n_envs, n_blocks), kernel.UNDRAWN)
        self._lengths = np.zeros(1 + n_envs)
        actions = np.zeros((3, n_envs, self._rule[-1].shape[1]))
        self._truncated = np.zeros(n_envs, np.bool_)
        self._last_observations = np.zeros((n_envs, obs_dim))
        self._episodes = (
            self._indices,
            self._probabilities,
            self._entries,
            actions,
            self._truncated,
            self._last_observations,
            self._held,
            self._lengths,
        )
        self._sums = np.zeros(3)
        self._places = np.zeros((n_envs, k), np.int64)
        self._work = self._sums, np.zeros((2, table.n_actions)), np.zeros(n_envs), self._places
        self._set_desk()

    def _set_desk(self) -> None:
        """Take up perception and memory as they are now."""
        self._eyes = self.perceiver.eyes
        memory, chance = self.live.memory(), (self.stream.rows, self.stream.taken)
        # A desk does not keep its arrays. All others are in attributes of their own.
        self._lent = memory, chance
        self._desk = set_desk(self._eyes, self._rule, self._form, self._episodes, memory, chance, self._work)
        self._learn = kernel.learn_on(self._desk)
        # One action for all neighbours is the column that the first answers for.
        averages, actions = self._rule[0] == kernel.AVERAGE, self._episodes[3]
        self._actions: np.ndarray = self._entries[kernel.NOW, :, 0, 0] if averages else actions[kernel.NOW]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in OF_THE_DESK}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._set_desk()

    def _make_room(self) -> None:
        most_new_points = self._places.size
        changed = self.table.reserve(most_new_points)
        if self.live.reserve(most_new_points) or changed:
            self._set_desk()

    def begin(self, observations: np.ndarray, rate: float) -> np.ndarray:
        check_finite("an observation", observations, range(self.n_envs))
        self.live.clear()
        self._set_desk()
        seen = as_rows(observations)
        if self.perceiver.search_is_outside:
            self._find(seen, kernel.NOW)
        kernel.begin(self._desk, seen, self.stream.next()[:, 0], rate)
        self.in_episodes = True
        return self._actions

    def learn(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> np.ndarray:
        if self.perceiver.eyes is not self._eyes:
            self._set_desk()
        self.live.is_published = False
        seen = observations if observations.dtype is FLOAT32 and observations.ndim == 2 else as_rows(observations)
        if self.perceiver.search_is_outside:
            check_transition(observations, rewards)
            self._find(seen, kernel.THEN)
        if truncated:
            self._take_in(truncated)
        # One by one, which numba takes in a quarter of a microsecond sooner than their tuple.
        alpha, trace_decay, rate = rates
        answer = self._learn(seen, rewards, ended, alpha, trace_decay, rate)
        while answer != FINE:
            if answer == USED_UP:
                self.stream.refill()
            elif answer == FULL:
                self._make_room()
            else:
                self._truncated[:] = False
                check_transition(observations, rewards)
                raise FloatingPointError(DIVERGENCE)
            answer = self._learn(seen, rewards, ended, alpha, trace_decay, rate)
        if truncated:
            self._truncated[:] = False
        return self._actions

    @property
    def n_traced(self) -> int:
        return self.live.count

    def summary(self) -> dict[str, float]:
        if not self._sums[2]:
            return {}
        td_error, q_mean = (self._sums[:2] / self._sums[2]).tolist()
        self._sums[:] = 0.0
        return {"td_error": td_error, "q_mean": q_mean}

    def state_dict(self) -> dict[str, Any]:
        return {
            "indices": th.from_numpy(self._indices[kernel.NOW].copy()),
            "probabilities": th.from_numpy(self._probabilities[kernel.NOW].copy()),
            "entries": th.from_numpy(self._entries[kernel.NOW].copy()),
            "held": th.from_numpy(self._held.copy()),
            "lengths": th.from_numpy(self._lengths.copy()),
            "traces": self.live.state(),
        }

    def _forget(self) -> None:
        self.live.forget()
        self._set_desk()

    def _take_over(self, state_dict: dict[str, Any]) -> None:
        self._indices[kernel.NOW] = state_dict["indices"].numpy()
        self._probabilities[kernel.NOW] = state_dict["probabilities"].numpy()
        self._entries[kernel.NOW] = state_dict["entries"].numpy()
        self._held[:] = state_dict["held"].numpy()
        self._lengths[:] = state_dict["lengths"].numpy()
        self.live.set_state(state_dict["traces"])
        self._set_desk()

    def _take_in(self, truncated: Mapping[int, np.ndarray]) -> None:
        for env, last_observation in truncated.items():
            self._truncated[env] = True
            self._last_observations[env] = last_observation
        if self.perceiver.search_is_outside:
            envs = list(truncated)
            self._find(self._last_observations[envs], kernel.LAST, envs)

    def _find(self, observations: np.ndarray, state: int, rows: Any = slice(None)) -> None:
        """Have the neighbours found by a search that the kernel does not have in it."""
        neighbors = self.perceiver.find(th.from_numpy(observations))
        self._indices[state, rows] = neighbors.indices.numpy()
        self._probabilities[state, rows] = neighbors.squared_distances.numpy()


def as_rows(observations: np.ndarray) -> np.ndarray:
    """
    :param observations: shape (batch, obs_dim), or (batch,) for Discrete, any number type
    :return: the same, shape (batch, obs_dim), in one of two types, so that the kernels are compiled for no more
    """
    if observations.dtype is not FLOAT32:
        observations = observations.astype(np.float64, copy=False)
    return observations if observations.ndim == 2 else observations[:, None]
