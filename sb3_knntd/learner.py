"""One step of learning: perceive, choose, compute the TD error, credit it along the traces."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.memory import QTable, Traces
from sb3_knntd.perception import Perceiver, Perception
from sb3_knntd.rules import ActionRule, Choice


class Transition(NamedTuple):
    """
    What the environments answered to the last actions.

    :param observations: what each sees now (after a reset where an episode ended), shape (n_envs, *obs_shape)
    :param rewards: shape (n_envs,)
    :param ended: whether the episode ended, shape (n_envs,), bool
    :param truncated: whether it ended by a time limit, shape (n_envs,), bool
    :param last_observations: the true last observation of each truncated environment, in the order of
        the environments, shape (truncated.sum(), *obs_shape)
    """

    observations: np.ndarray
    rewards: np.ndarray
    ended: np.ndarray
    truncated: np.ndarray
    last_observations: np.ndarray


class Rates(NamedTuple):
    """
    The scheduled parameters at one step.

    :param learning_rate: α
    :param trace_decay: λ
    :param exploration: ε or the temperature
    """

    learning_rate: float
    trace_decay: float
    exploration: float


class Learner(nn.Module):
    """
    Algorithms 1 to 3 of the paper as torch operations on any device, batched over environments. Between
    calls it holds the state of each episode: perception and choice at the current observation, and traces.

    :param perceiver: where am I?
    :param table: what is it worth?
    :param rule: what do I do?
    :param n_envs: number of environments
    :param gamma: γ
    :param normalized: whether the step is α / Σp² in place of α
    :param traces: ``"replacing"`` or ``"accumulating"``
    :param reset_other_actions: see :class:`~sb3_knntd.memory.Traces`
    """

    indices: th.Tensor
    probabilities: th.Tensor
    entries: th.Tensor

    def __init__(
        self,
        perceiver: Perceiver,
        table: QTable,
        rule: ActionRule,
        n_envs: int,
        gamma: float,
        normalized: bool,
        traces: str,
        reset_other_actions: bool,
    ) -> None:
        super().__init__()
        # Belonging to the policy, which saves them: kept out of this module's own state.
        self._parts = (perceiver, table, rule)
        self.n_envs = n_envs
        self.gamma = gamma
        self.normalized = normalized
        self.traces = Traces(table, n_envs, traces, reset_other_actions)
        shape, values = (n_envs, perceiver.search.n_neighbors), table.values
        self.register_buffer("indices", th.zeros(shape, dtype=th.int64, device=values.device))
        self.register_buffer("probabilities", values.new_zeros(shape))
        self.register_buffer("entries", th.zeros(shape, dtype=th.int64, device=values.device))
        self._sums = values.new_zeros(2)
        self._n_sums = 0

    def begin(self, observations: np.ndarray, uniforms: np.ndarray, rates: Rates) -> np.ndarray:
        """
        Start an episode in every environment.

        :param observations: shape (n_envs, *obs_shape)
        :param uniforms: random numbers in [0, 1), shape (n_envs, n_uniforms)
        :param rates: the scheduled parameters
        :return: index of the action to take in each environment, shape (n_envs,), int64
        """
        self.traces.clear()
        perception, choice = self._choose(observations, uniforms, rates)
        return self._settle_in(perception, choice)

    def learn(self, transition: Transition, uniforms: np.ndarray, rates: Rates) -> np.ndarray:
        """
        Learn from what the last actions led to, and choose the next.

        :param transition: what the environments answered
        :param uniforms: random numbers in [0, 1), shape (n_envs, 2, n_uniforms): for the next action, and for
            the one that would have been taken at a truncation
        :param rates: the scheduled parameters
        :return: index of the action to take in each environment, shape (n_envs,), int64
        """
        table = self._parts[1]
        perception, choice = self._choose(transition.observations, uniforms[:, 0], rates)
        worth = choice.values
        if transition.truncated.any():
            _, last = self._choose(transition.last_observations, uniforms[transition.truncated, 1], rates)
            worth = worth.index_put((self._tensor(transition.truncated),), last.values)

        ended = self._tensor(transition.ended)
        bootstraps = self._tensor(~transition.ended | transition.truncated)
        target = self._tensor(transition.rewards).to(worth.dtype) + self.gamma * worth * bootstraps
        value = self._value()
        errors = target - value
        step = rates.learning_rate
        corrections = step * errors / self.probabilities.square().sum(dim=1) if self.normalized else step * errors

        self.traces.mark(self.indices, self.entries, self.probabilities)
        self.traces.credit(table, corrections)
        self.traces.decay(self.gamma * rates.trace_decay, ended)
        table.visited[self.indices] = True
        self._sums += th.stack((errors.abs().sum(), value.sum()))
        self._n_sums += self.n_envs
        return self._settle_in(perception, choice)

    def summary(self) -> dict[str, float]:
        """
        :return: ``td_error``, the mean absolute TD error, and ``q_mean``, the mean value of the states and
            actions learned from, both since the last call; empty if nothing was learned
        """
        if not self._n_sums:
            return {}
        td_error, q_mean = (self._sums / self._n_sums).tolist()
        self._sums.zero_()
        self._n_sums = 0
        return {"td_error": td_error, "q_mean": q_mean}

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Take over a saved state; one of another number of environments holds no episode of these."""
        if len(state_dict["indices"]) != self.n_envs:
            self.traces.clear()
            return None
        return super().load_state_dict(state_dict, strict, assign)

    def _choose(self, observations: np.ndarray, uniforms: np.ndarray, rates: Rates) -> tuple[Perception, Choice]:
        perceiver, table, rule = self._parts
        perception = perceiver(self._tensor(observations))
        probabilities = perception.probabilities.to(table.values.dtype)
        rows = table.rows(perception.indices)
        choice = rule.choose(rows, probabilities, self._tensor(uniforms), rates.exploration)
        return Perception(perception.indices, probabilities), choice

    def _value(self) -> th.Tensor:
        """Q(s, a) at the state and action that each environment is leaving, shape (n_envs,)."""
        taken = self._parts[1].rows(self.indices).gather(2, self.entries[..., None])[..., 0]
        return (self.probabilities * taken).sum(dim=1)

    def _settle_in(self, perception: Perception, choice: Choice) -> np.ndarray:
        self.indices.copy_(perception.indices)
        self.probabilities.copy_(perception.probabilities)
        self.entries.copy_(choice.entries)
        actions: np.ndarray = choice.actions.cpu().numpy()
        return actions

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(np.ascontiguousarray(array)).to(self.indices.device)
