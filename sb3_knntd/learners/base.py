"""One step of learning: perceive, choose, compute the TD error, credit it along the traces."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.actions.selection import ActionRule, Choice
from sb3_knntd.common.checks import check_finite
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.common.state_checks import checked_integer, checked_points, checked_tensor, entry
from sb3_knntd.kernels.memory import LEAST_CLOCK
from sb3_knntd.kernels.step import UNDRAWN, count_steps
from sb3_knntd.perception import Perceiver, Perception
from sb3_knntd.q_table import DenseTable, DenseTraces, LiveStore, OneStepTraces, QTable, Traces

#: By how much a saved share may exceed 1, or a sum of probabilities differ from it.
ROUNDING = 1e-3
#: The scheduled parameters at one step: α, λ, and ε or the temperature.
Rates = tuple[float, float, float]


class Form(NamedTuple):
    """
    Which of the update's forms.

    :param gamma: γ
    :param normalized: whether the step is α / Σp² in place of α
    :param accumulating: whether traces accumulate (eq. 15) in place of being replaced (eq. 16)
    :param reset_other_actions: whether a replacing trace clears those of the other actions
    """

    gamma: float
    normalized: bool
    accumulating: bool
    reset_other_actions: bool


class Learner(ABC):
    """
    Algorithms 1 to 3 of the paper, for several environments in step. Between calls it holds where each episode
    is: perception and choice at the current observation, and traces.
    """

    n_envs: int
    perceiver: Perceiver
    table: QTable
    #: number of environments, neighbours, and blocks of columns
    shape: tuple[int, int, int]
    #: whether it holds where the episodes are
    in_episodes = False

    @abstractmethod
    def begin(self, observations: np.ndarray, rate: float) -> np.ndarray:
        """
        Start an episode in every environment.

        :param observations: shape (n_envs, *obs_shape)
        :param rate: ε or the temperature
        :return: the action to take in each environment: its index, shape (n_envs,), int64, or a vector, shape
            (n_envs, action_dim); it holds until the next call
        :raises ValueError: if an observation is not finite
        """

    @abstractmethod
    def learn(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> np.ndarray:
        """
        Learn from what the last actions led to, and choose the next.

        :param observations: what each environment shows now (after a reset where an episode ended), shape
            (n_envs, *obs_shape)
        :param rewards: shape (n_envs,)
        :param ended: whether the episode ended, shape (n_envs,), bool
        :param truncated: the environments whose episode ended by a time limit, and the true last observation of each of
            these, shape obs_shape
        :param rates: the scheduled parameters
        :return: the action to take in each environment: its index, shape (n_envs,), int64, or a vector, shape
            (n_envs, action_dim); it holds until the next call
        :raises ValueError: if an observation or reward is not finite; nothing has been changed then
        :raises FloatingPointError: if the values have diverged; nothing has been changed then
        """

    @property
    @abstractmethod
    def n_traced(self) -> int:
        """Number of points that have a trace."""

    @abstractmethod
    def summary(self) -> dict[str, float]:
        """
        :return: ``td_error``, the mean absolute TD error, and ``q_mean``, the mean value of the states and
            actions learned from, both since the last call; empty if nothing was learned
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """
        :return: tensors and numbers; the same keys for every learner
        """

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        """
        Take over the state of a learner of the same table. One of another number of environments or neighbours
        holds no episode of these, and is left.

        :param state_dict: what :meth:`state_dict` returned
        :param strict: part of torch's signature; a state is always taken whole
        :raises ValueError: if no learner can have returned it; the message says why
        """
        in_episodes = getattr(entry(state_dict, "entries"), "shape", None) == self.shape
        if in_episodes:
            self._check_state(state_dict)
            # One that has not begun yet.
            in_episodes = bool(state_dict["probabilities"].any())
        self._forget()
        self.in_episodes = in_episodes
        if in_episodes:
            self._take_over(state_dict)

    @abstractmethod
    def _forget(self) -> None:
        """Let go where the episodes are."""

    @abstractmethod
    def _take_over(self, state_dict: dict[str, Any]) -> None:
        """Take over a state that fits."""

    def _check_state(self, state: dict[str, Any]) -> None:
        n_envs, k, n_blocks = self.shape
        n_points, n_actions = self.perceiver.points.n_points, self.table.n_actions
        checked_tensor(state, "indices", (n_envs, k), th.int64, 0, n_points - 1)
        probabilities = checked_tensor(state, "probabilities", (n_envs, k), th.float64, 0.0, 1.0 + ROUNDING)
        if probabilities.any() and not ((probabilities.sum(dim=1) - 1.0).abs() <= ROUNDING).all():
            raise ValueError(f"probabilities must sum to 1 in every row; got {probabilities.sum(dim=1).tolist()}")
        checked_tensor(state, "entries", (n_envs, k, n_blocks), th.int64, 0, n_actions - 1)
        checked_tensor(state, "held", (n_envs, n_blocks), th.int64, UNDRAWN, n_actions - 1)
        checked_tensor(state, "lengths", (1 + n_envs,), th.float64, 0.0)
        traces, rows = entry(state, "traces"), self.table.points()
        live = checked_points(traces, "points", n_points)
        if rows is not None and not th.isin(live, rows).all():
            raise ValueError("points must be those that the table has rows for; some have a trace and no row")
        n = len(live)
        checked_tensor(traces, "traces", (n, n_actions, n_envs), th.float64, 0.0)
        checked_tensor(traces, "share", (n, n_actions), th.float64, 0.0, 1.0 + ROUNDING)
        checked_tensor(traces, "base", (n, n_actions), th.float64)
        pace = checked_tensor(traces, "pace", (1 + n_envs,), th.float64)
        if not LEAST_CLOCK <= pace[0] <= 1.0:
            raise ValueError(f"pace must begin with a number within [{LEAST_CLOCK:g}, 1]; got {pace[0]:g}")
        # A store has grown to no more than this, see LiveStore.reserve.
        most = 4 * (n_points if rows is None else len(rows)) + 2 * n_envs * k
        checked_integer(traces, "capacity", n, max(most, LiveStore.SMALLEST))


def check_transition(observations: np.ndarray, rewards: np.ndarray) -> None:
    """
    :param observations: a row for each environment
    :param rewards: one for each environment
    :raises ValueError: if an observation or reward is not finite; the message says where
    """
    check_finite("an observation", observations, range(len(rewards)))
    check_finite("a reward", rewards, range(len(rewards)))


DIVERGENCE = (
    "the action values have diverged and are no longer finite: lower learning_rate, or trace_decay, or use "
    "step_size='normalized' and gamma < 1"
)


class TorchLearner(Learner):
    """
    The step as torch operations on any device, with traces as the equations have them: the reference.

    :param perceiver: where am I?
    :param table: what is it worth?
    :param rule: what do I do?
    :param stream: rows of random numbers, shape (n_envs, 2, rule.n_uniforms)
    :param n_envs: number of environments
    :param form: which of the update's forms
    :param one_step: whether λ is 0 throughout, and no trace has to be kept
    """

    table: DenseTable

    def __init__(
        self,
        perceiver: Perceiver,
        table: DenseTable,
        rule: ActionRule,
        stream: RandomStream,
        n_envs: int,
        form: Form,
        one_step: bool = False,
    ) -> None:
        self.perceiver = perceiver
        self.table = table
        self.rule = rule
        self.stream = stream
        self.n_envs = n_envs
        self.form = form
        kind = "accumulating" if form.accumulating else "replacing"
        self.traces: Traces = (
            OneStepTraces(table, n_envs) if one_step else DenseTraces(table, n_envs, kind, form.reset_other_actions)
        )
        shape, values = (n_envs, perceiver.search.n_neighbors), table.values
        self.indices = th.zeros(shape, dtype=th.int64, device=values.device)
        self.probabilities = values.new_zeros(shape)
        n_blocks = len(rule.blocks) - 1
        self.entries = th.zeros((*shape, n_blocks), dtype=th.int64, device=values.device)
        self.shape = (*shape, n_blocks)
        #: what each environment is exploring, see :meth:`~sb3_knntd.actions.selection.ActionRule.hold`
        self.held = th.full((n_envs, n_blocks), UNDRAWN, dtype=th.int64, device=values.device)
        #: see :func:`~sb3_knntd.kernels.step.count_steps`; on the CPU, where it is known which episodes ended
        self.lengths = np.zeros(1 + n_envs)
        self._sums = values.new_zeros(2)
        self._n_sums = 0

    def begin(self, observations: np.ndarray, rate: float) -> np.ndarray:
        check_finite("an observation", observations, range(self.n_envs))
        uniforms = self.stream.next()[:, 0]
        self.traces.clear()
        self.lengths[1:] = 0.0
        self._hold(UNDRAWN, uniforms, rate)
        perception, choice = self._choose(observations, uniforms, rate, self.held)
        return self._settle_in(perception, choice)

    def learn(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> np.ndarray:
        uniforms = self.stream.next()
        check_transition(observations, rewards)
        count_steps(self.lengths, ended)
        held, over = self.held, self._tensor(ended)
        self._hold(th.where(over[:, None], UNDRAWN, held), uniforms[:, 0], rates[2])
        perception, choice = self._choose(observations, uniforms[:, 0], rates[2], self.held)
        worth = choice.values * self._tensor(~ended)
        if truncated:
            envs, last_observations = list(truncated), np.array(list(truncated.values()))
            _, last = self._choose(last_observations, uniforms[envs, 1], rates[2], held[envs])
            worth[envs] = last.values

        value = self._value()
        errors = self._tensor(rewards).to(worth.dtype) + self.form.gamma * worth - value
        corrections = rates[0] * errors
        if self.form.normalized:
            corrections = corrections / self.probabilities.square().sum(dim=1)
        # On an accelerator looking would mean waiting for it.
        if corrections.is_cpu and not th.isfinite(corrections).all():
            raise FloatingPointError(DIVERGENCE)

        self.traces.mark(self.indices, self.entries, self.probabilities)
        self.traces.credit(corrections)
        self.traces.decay(self.form.gamma * rates[1], over)
        self.table.visit(self.indices)
        self._sums += th.stack((errors.abs().sum(), value.sum()))
        self._n_sums += self.n_envs
        return self._settle_in(perception, choice)

    @property
    def n_traced(self) -> int:
        return len(self.traces.state()["points"])

    def summary(self) -> dict[str, float]:
        if not self._n_sums:
            return {}
        td_error, q_mean = (self._sums / self._n_sums).tolist()
        self._sums.zero_()
        self._n_sums = 0
        return {"td_error": td_error, "q_mean": q_mean}

    def state_dict(self) -> dict[str, Any]:
        return {
            "indices": self.indices.cpu(),
            "probabilities": self.probabilities.double().cpu(),
            "entries": self.entries.cpu(),
            "held": self.held.cpu(),
            "lengths": th.from_numpy(self.lengths.copy()),
            "traces": self.traces.state(),
        }

    def _forget(self) -> None:
        self.traces.clear()

    def _take_over(self, state_dict: dict[str, Any]) -> None:
        for name in ("indices", "probabilities", "entries", "held"):
            getattr(self, name).copy_(state_dict[name])
        self.lengths[:] = state_dict["lengths"].numpy()
        self.traces.set_state(state_dict["traces"])

    def _hold(self, held: th.Tensor | int, uniforms: np.ndarray, rate: float) -> None:
        start = held if isinstance(held, th.Tensor) else th.full_like(self.held, held)
        lengths = self._tensor(np.maximum(self.lengths[0], self.lengths[1:]))
        self.held = self.rule.hold(start, self._tensor(uniforms), rate, lengths)

    def _choose(
        self, observations: np.ndarray, uniforms: np.ndarray, rate: float, held: th.Tensor
    ) -> tuple[Perception, Choice]:
        perception = self.perceiver(self._tensor(observations))
        probabilities = perception.probabilities.to(self.table.values.dtype)
        rows = self.table.rows(perception.indices)
        choice = self.rule.choose(rows, probabilities, self._tensor(uniforms), rate, held)
        return Perception(perception.indices, probabilities), choice

    def _value(self) -> th.Tensor:
        """Q(s, a) at the state and action that each environment is leaving, shape (n_envs,)."""
        return self.rule.value(self.table.rows(self.indices), self.probabilities, self.entries)

    def _settle_in(self, perception: Perception, choice: Choice) -> np.ndarray:
        self.in_episodes = True
        self.indices.copy_(perception.indices)
        self.probabilities.copy_(perception.probabilities)
        self.entries.copy_(choice.entries)
        actions: np.ndarray = choice.actions.cpu().numpy()
        return actions

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(np.ascontiguousarray(array)).to(self.indices.device)
