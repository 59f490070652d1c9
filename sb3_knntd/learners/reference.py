"""One step of learning as torch operations: the reference."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th

from sb3_knntd.actions.rules import masked
from sb3_knntd.actions.selection import ActionSelector, Selection
from sb3_knntd.common.checks import check_finite
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.common.transitions import check_transition
from sb3_knntd.kernels.selection import UNDRAWN, count_steps
from sb3_knntd.kernels.state import UpdateConfig
from sb3_knntd.kernels.traces import LARGEST_VALUE
from sb3_knntd.learners.base import DIVERGENCE, Learner, Rates, Transitions, check_rates, update_rates
from sb3_knntd.perception import Experience, Perceiver, Perception
from sb3_knntd.q_table import DenseTable, DenseTraces, OneStepTraces, Traces


class TorchLearner(Learner):
    """
    The learning step as torch operations on any device, with traces as in the paper's equations.

    :param perceiver: finds and weighs the neighbours of an observation
    :param table: the Q-table
    :param selector: selects actions
    :param stream: rows of random numbers, shape (n_envs, 2, selector.n_uniforms)
    :param n_envs: number of environments
    :param config: variant of the update
    :param experience: where each step is recorded
    :param one_step: whether λ is always 0, so that no traces are stored
    """

    table: DenseTable

    def __init__(
        self,
        perceiver: Perceiver,
        table: DenseTable,
        selector: ActionSelector,
        stream: RandomStream,
        n_envs: int,
        config: UpdateConfig,
        experience: Experience,
        one_step: bool = False,
    ) -> None:
        super().__init__(perceiver, table, selector, n_envs, config, experience)
        self.stream = stream
        self.one_step = one_step
        self.traces = self._make_traces(n_envs)
        values, n_factors = table.values, selector.n_factors
        self.indices = th.zeros(self.shape[:2], dtype=th.int64, device=values.device)
        self.probabilities = values.new_zeros(self.shape[:2])
        self.action_indices = th.zeros(self.shape, dtype=th.int64, device=values.device)
        #: persistent actions, see :meth:`~sb3_knntd.actions.selection.ActionSelector.persist`
        self.persistent = th.full((n_envs, n_factors), UNDRAWN, dtype=th.int64, device=values.device)
        #: the columns that the rules forbid in the current states
        self.forbidden = th.zeros((n_envs, table.n_actions), dtype=th.bool, device=values.device)
        #: see :func:`~sb3_knntd.kernels.selection.count_steps`; on the CPU, like ``ended``
        self.lengths = np.zeros(1 + n_envs)
        self._observations = th.full((n_envs, perceiver.bounds.obs_dim), th.inf, dtype=th.float64)
        self._actions = np.empty(0)
        self._sums = values.new_zeros(2)
        self._n_sums = 0

    def _make_traces(self, n_envs: int) -> Traces:
        if self.one_step:
            return OneStepTraces(self.table, n_envs)
        kind = "accumulating" if self.config.accumulating else "replacing"
        return DenseTraces(self.table, n_envs, kind, self.config.reset_other_actions)

    @property
    def actions(self) -> np.ndarray:
        return self._actions

    def configure(self, selector: ActionSelector, config: UpdateConfig) -> None:
        super().configure(selector, config)
        state = self.traces.state()
        self.traces = self._make_traces(self.n_envs)
        self.traces.set_state(state)

    def begin(self, observations: np.ndarray, exploration_rate: float) -> None:
        check_finite("an observation", observations, range(self.n_envs))
        self.rules_version = self.selector.rules.version
        uniforms = self.stream.next()[:, 0]
        self._grow(observations, {})
        self._follow_table()
        self.traces.clear()
        self.lengths[1:] = 0.0
        self._persist(UNDRAWN, uniforms, exploration_rate)
        perception, selection = self._select(observations, uniforms, exploration_rate, self.persistent)
        self._observations = self._tensor(observations).reshape(self.n_envs, -1)
        self._advance(observations, perception, selection)

    def step(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> None:
        check_rates(rates, self.selector)
        uniforms = self.stream.next()
        check_transition(observations, rewards)
        with self.table.lock:
            self._grow(observations, truncated)
            self._follow_table()
            self._step(observations, rewards, ended.astype(bool), truncated, rates, uniforms)

    def _step(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
        uniforms: np.ndarray,
    ) -> None:
        count_steps(self.lengths, ended)
        persistent, over = self.persistent, self._tensor(ended)
        self._persist(th.where(over[:, None], UNDRAWN, persistent), uniforms[:, 0], rates[2])
        perception, selection = self._select(observations, uniforms[:, 0], rates[2], self.persistent)
        target_values = selection.target_values * self._tensor(~ended)
        if truncated:
            envs, last_observations = list(truncated), np.array(list(truncated.values()))
            _, last = self._select(last_observations, uniforms[envs, 1], rates[2], persistent[envs])
            target_values[envs] = last.target_values

        value = self._value()
        errors = self._tensor(rewards).to(target_values.dtype) + self.config.gamma * target_values - value
        self._update(self.traces, self.indices, self.probabilities, self.action_indices, errors, over, rates)
        self.table.visit(self.indices)
        self._sums += th.stack((errors.abs().sum(), value.sum()))
        self._n_sums += self.n_envs
        before, self._observations = self._observations, self._tensor(observations).reshape(self.n_envs, -1)
        self.experience.record(before, self._observations, self._tensor(rewards), over, self.perceiver.bounds)
        self._advance(observations, perception, selection)

    def _update(
        self,
        traces: Traces,
        indices: th.Tensor,
        probabilities: th.Tensor,
        action_indices: th.Tensor,
        errors: th.Tensor,
        over: th.Tensor,
        rates: Rates,
    ) -> None:
        """Credit TD errors, shape (n_envs,), along the traces; ``over`` tells which episodes ended."""
        corrections = rates[0] * errors
        if self.config.normalized:
            corrections = corrections / probabilities.square().sum(dim=1)
        # On an accelerator, this check would make the host wait.
        before = self._copy_if_large(corrections) if corrections.is_cpu else None
        traces.mark(indices, action_indices, probabilities)
        traces.credit(corrections)
        if before is not None and not self.table.values.abs().max() <= LARGEST_VALUE:
            self.table.values.copy_(before)
            raise FloatingPointError(DIVERGENCE)
        traces.decay(self.config.gamma * rates[1], over)

    def _copy_if_large(self, corrections: th.Tensor) -> th.Tensor | None:
        """A copy of the table's values, if they could exceed ``LARGEST_VALUE``. Traces are below 1e9."""
        bound = float(self.table.values.abs().max() + 1e9 * corrections.abs().sum())
        if bound <= LARGEST_VALUE:
            return None
        if not th.isfinite(corrections).all():
            raise FloatingPointError(DIVERGENCE)
        return self.table.values.clone()

    def update(self, transitions: Transitions, learning_rate: float, trace_decay: float) -> None:
        rates = update_rates(learning_rate, trace_decay)
        columns = transitions.columns(self.selector, self.perceiver.bounds.obs_dim)
        self.grow_for(transitions)
        with self.table.lock:
            self._follow_table()
            traces = self._make_traces(1)
            goes_on = False
            for t in range(len(columns)):
                goes_on = self._update_from(traces, transitions, th.from_numpy(columns[t]), t, goes_on, rates)
            self._record(transitions, len(columns))

    def _update_from(
        self, traces: Traces, transitions: Transitions, column: th.Tensor, t: int, goes_on: bool, rates: Rates
    ) -> bool:
        """Learn from one transition; whether the next one continues it."""
        device = self.indices.device
        rows, allowed, probabilities, indices = self._rows_at(transitions.observations[t])
        _, next_rows, next_probabilities, _ = self._rows_at(transitions.next_observations[t])
        given = self.selector.given_value(rows, probabilities, column[None].to(device))
        greedy = self.selector.greedy_value(allowed, probabilities)
        if goes_on and bool(given < greedy):
            traces.clear()
        action_indices = column.to(device).expand(1, rows.shape[1], len(column))
        value = self.selector.value(rows, probabilities, action_indices, allowed)
        target = self.selector.greedy_value(next_rows, next_probabilities) * float(not transitions.terminated[t])
        errors = float(transitions.rewards[t]) + self.config.gamma * target - value
        over = th.tensor([bool(transitions.ended[t])], device=device)
        self._update(traces, indices, probabilities, action_indices, errors, over, rates)
        self.table.visit(indices)
        return not transitions.ended[t]

    def _rows_at(self, observation: np.ndarray) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """The rows of the neighbours, the same without forbidden actions, the probabilities and the neighbours."""
        seen = self._tensor(np.asarray(observation)[None])
        perception = self.perceiver(seen)
        rows = self.table.rows(perception.indices)
        probabilities = perception.probabilities.to(rows.dtype)
        return rows, self.selector.rules.mask(rows, probabilities, seen), probabilities, perception.indices

    def _follow_table(self) -> None:
        """Make new traces if the number of rows of the table has changed; if it has grown, the old ones are kept."""
        n_before, n_rows = self.traces.n_points, len(self.table.values)
        if n_before != n_rows:
            state = self.traces.state()
            self.traces = self._make_traces(self.n_envs)
            if n_before < n_rows:
                self.traces.set_state(state)

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
            # All zeros if there are no current episodes.
            "probabilities": self.probabilities.double().cpu() * self.in_episodes,
            "entries": self.action_indices.cpu(),
            "held": self.persistent.cpu(),
            "lengths": th.from_numpy(self.lengths.copy()),
            "observations": self._observations.double().cpu(),
            "forbidden": self.forbidden.cpu(),
            "traces": self.traces.state(),
        }

    def _forget(self) -> None:
        self._follow_table()
        self.traces.clear()

    def _take_over(self, state_dict: dict[str, Any]) -> None:
        self.indices.copy_(state_dict["indices"])
        self.probabilities.copy_(state_dict["probabilities"])
        self.action_indices.copy_(state_dict["entries"])
        self.persistent.copy_(state_dict["held"])
        self.lengths[:] = state_dict["lengths"].numpy()
        self._observations = self._observations_in(state_dict).to(self.indices.device)
        self.forbidden.copy_(state_dict["forbidden"])
        self.traces.set_state(state_dict["traces"])
        actions = self.selector.actions_of(self.action_indices, self.probabilities)
        self._actions = actions.cpu().numpy()

    def _persist(self, persistent: th.Tensor | int, uniforms: np.ndarray, rate: float) -> None:
        start = persistent if isinstance(persistent, th.Tensor) else th.full_like(self.persistent, persistent)
        lengths = self._tensor(np.maximum(self.lengths[0], self.lengths[1:]))
        self.persistent = self.selector.persist(start, self._tensor(uniforms), rate, lengths)

    def _select(
        self, observations: np.ndarray, uniforms: np.ndarray, rate: float, persistent: th.Tensor
    ) -> tuple[Perception, Selection]:
        seen = self._tensor(observations)
        perception = self.perceiver(seen)
        probabilities = perception.probabilities.to(self.table.values.dtype)
        rows = self.selector.rules.mask(self.table.rows(perception.indices), probabilities, seen)
        selection = self.selector.select(rows, probabilities, self._tensor(uniforms), rate, persistent)
        return Perception(perception.indices, probabilities), selection

    def _value(self) -> th.Tensor:
        """Q(s, a) at the current state and action of each environment, shape (n_envs,)."""
        rows = self.table.rows(self.indices)
        allowed = masked(rows, self.probabilities, self.forbidden) if len(self.selector.rules) else rows
        return self.selector.value(rows, self.probabilities, self.action_indices, allowed)

    def _advance(self, observations: np.ndarray, perception: Perception, selection: Selection) -> None:
        self.in_episodes = True
        if len(self.selector.rules):
            self.forbidden.copy_(self.selector.rules.forbidden(self._tensor(observations)))
        self.indices.copy_(perception.indices)
        self.probabilities.copy_(perception.probabilities)
        self.action_indices.copy_(selection.action_indices)
        self._actions = selection.actions.cpu().numpy()

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(np.ascontiguousarray(array)).to(self.indices.device)
