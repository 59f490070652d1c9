"""Eligibility traces as in the paper's equations: the reference for the faster implementations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch as th

from sb3_knntd.q_table.table import DenseTable


class Traces(ABC):
    """
    Eligibility traces of the torch learner, on any device.

    The environments share the table, and each has its own traces. If several have a trace at the same entry, it changes
    by the mean of their TD errors, weighted by eligibility, times the largest eligibility. So the step size does not
    grow with the number of environments in the same place. With one environment this is eq. 14.
    """

    #: number of points of the table
    n_points: int

    @abstractmethod
    def mark(self, indices: th.Tensor, action_indices: th.Tensor, probabilities: th.Tensor) -> None:
        """
        Set the traces of the current state of each environment.

        :param indices: neighbours, shape (n_envs, k), int64
        :param action_indices: columns that each neighbour selected, shape (n_envs, k, n_factors), int64
        :param probabilities: of the neighbours, shape (n_envs, k), the table's dtype
        """

    @abstractmethod
    def credit(self, corrections: th.Tensor) -> None:
        """
        Q += α δ e (eq. 14).

        :param corrections: α δ of each environment, shape (n_envs,), the table's dtype
        """

    @abstractmethod
    def decay(self, factor: float, ended: th.Tensor) -> None:
        """
        e *= γ λ (eq. 17), and e = 0 in episodes that have ended.

        :param factor: γ λ
        :param ended: whether each environment's episode has ended, shape (n_envs,), bool
        """

    @abstractmethod
    def clear(self) -> None:
        """Drop all traces."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """
        :return: the nonzero traces, in the format of :class:`~sb3_knntd.q_table.ActiveTraces`
        """

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """
        :param state: the state of such traces or of a :class:`~sb3_knntd.q_table.ActiveTraces`, for the same number of
            environments
        """


class DenseTraces(Traces):
    """
    One number for each environment and entry of the table. Each step updates all of them.

    :param table: the Q-table
    :param n_envs: number of environments
    :param kind: ``"replacing"`` (eq. 16) or ``"accumulating"`` (eq. 15)
    :param reset_other_actions: whether a replacing trace clears those of the other actions at its points
        (line 16 of Algorithm 3)
    """

    def __init__(self, table: DenseTable, n_envs: int, kind: str, reset_other_actions: bool) -> None:
        self.table = table
        self.kind = kind
        self.reset_other_actions = reset_other_actions
        self.n_points = len(table.values)
        self.eligibility = table.values.new_zeros((n_envs, *table.values.shape))
        self._envs = th.arange(n_envs, device=table.values.device)[:, None]

    def mark(self, indices: th.Tensor, action_indices: th.Tensor, probabilities: th.Tensor) -> None:
        marked = (self._envs[..., None], indices[..., None], action_indices)
        if self.kind == "accumulating":
            self.eligibility[marked] += probabilities[..., None]
            return
        if self.reset_other_actions:
            self.eligibility[self._envs, indices] = 0.0
        self.eligibility[marked] = probabilities[..., None].expand(action_indices.shape)

    def credit(self, corrections: th.Tensor) -> None:
        total = th.tensordot(corrections, self.eligibility, dims=1)
        if len(corrections) > 1:
            largest, together = self.eligibility.amax(dim=0), self.eligibility.sum(dim=0)
            total *= th.where(together > 0, largest / together, 0.0)
        self.table.values += total

    def decay(self, factor: float, ended: th.Tensor) -> None:
        # A product: indexing by a mask would make the host wait for an accelerator.
        self.eligibility *= factor * (~ended).to(self.eligibility.dtype)[:, None, None]

    def clear(self) -> None:
        self.eligibility.zero_()

    def state(self) -> dict[str, Any]:
        points = self.eligibility.any(dim=2).any(dim=0).nonzero()[:, 0]
        traces = self.eligibility[:, points].permute(1, 2, 0).double().cpu().contiguous()
        together = traces.sum(dim=2)
        return {
            "points": points.cpu(),
            "base": self.table.values[points].double().cpu(),
            "traces": traces,
            "share": th.where(together > 0, traces.amax(dim=2) / together, 1.0),
            "pace": th.eye(1, 1 + len(self.eligibility), dtype=th.float64)[0],
            "capacity": max(1024, 2 * len(points)),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        self.clear()
        traces = (state["traces"] * state["pace"][0]).permute(2, 0, 1)
        self.eligibility[:, state["points"].to(self.eligibility.device)] = traces.to(self.eligibility)


class OneStepTraces(Traces):
    """
    Traces for λ = 0. A trace lasts only for the step that sets it, so a step costs O(n_envs · k) and needs no table of
    traces. On an accelerator, sums over environments have no fixed order, and the last digit may vary.

    :param table: the Q-table
    :param n_envs: number of environments
    """

    def __init__(self, table: DenseTable, n_envs: int) -> None:
        self.n_envs = n_envs
        self.n_points = len(table.values)
        self._values = table.values.view(-1)
        self._n_actions = table.n_actions
        self._together, self._largest = self._values.new_zeros((2, len(self._values) if n_envs > 1 else 0))

    def mark(self, indices: th.Tensor, action_indices: th.Tensor, probabilities: th.Tensor) -> None:
        self._marked = (indices[..., None] * self._n_actions + action_indices).view(-1)
        self._eligibility = probabilities[..., None].expand(action_indices.shape).reshape(-1)

    def credit(self, corrections: th.Tensor) -> None:
        moves = self._eligibility * corrections.repeat_interleave(
            len(self._marked) // self.n_envs, output_size=len(self._marked)
        )
        if self.n_envs > 1:
            together = self._together.index_add_(0, self._marked, self._eligibility)[self._marked]
            largest = self._largest.scatter_reduce_(0, self._marked, self._eligibility, "amax")[self._marked]
            moves = moves * th.where(together > 0, largest / together, 0.0)
            self._together[self._marked] = 0.0
            self._largest[self._marked] = 0.0
        self._values.index_add_(0, self._marked, moves)

    def decay(self, factor: float, ended: th.Tensor) -> None:
        """Do nothing: no trace outlasts its step."""

    def clear(self) -> None:
        """Do nothing: no trace is stored between steps."""

    def state(self) -> dict[str, Any]:
        return {
            "points": th.zeros(0, dtype=th.int64),
            "base": th.zeros((0, self._n_actions), dtype=th.float64),
            "traces": th.zeros((0, self._n_actions, self.n_envs), dtype=th.float64),
            "share": th.zeros((0, self._n_actions), dtype=th.float64),
            "pace": th.eye(1, 1 + self.n_envs, dtype=th.float64)[0],
            "capacity": 1024,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Do nothing: with λ = 0 there are no traces when a state is saved."""
