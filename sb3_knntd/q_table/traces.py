"""Eligibility traces as the equations have them: the reference that faster forms are held to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch as th

from sb3_knntd.q_table.table import DenseTable


class Traces(ABC):
    """
    What the torch step asks of traces, on any device.

    Environments share the table and keep their own traces. Where those of several meet at an entry, it
    moves by the mean of their TD errors, weighted by eligibility, times the largest eligibility: many
    environments in the same place do not multiply the step, and one environment alone has eq. 14.
    """

    #: number of points of the table that they are for
    n_points: int

    @abstractmethod
    def mark(self, indices: th.Tensor, entries: th.Tensor, probabilities: th.Tensor) -> None:
        """
        Set the traces of the state each environment is in.

        :param indices: points, shape (n_envs, k)
        :param entries: the columns of each, shape (n_envs, k, n_factors)
        :param probabilities: what to set, shape (n_envs, k), the table's dtype
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
        e *= γ λ (eq. 17), and no trace outlives its episode.

        :param factor: γ λ
        :param ended: whether each environment's episode has ended, shape (n_envs,), bool
        """

    @abstractmethod
    def clear(self) -> None:
        """Let go all traces."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """
        :return: the traces that are not zero, in the form of :class:`~sb3_knntd.q_table.ActiveTraces`
        """

    @abstractmethod
    def set_state(self, state: dict[str, Any]) -> None:
        """
        :param state: of these traces or of a :class:`~sb3_knntd.q_table.ActiveTraces`, for as many environments
        """


class DenseTraces(Traces):
    """
    One number for every environment and entry, all of them touched at every step.

    :param table: the table that the traces are for
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

    def mark(self, indices: th.Tensor, entries: th.Tensor, probabilities: th.Tensor) -> None:
        marked = (self._envs[..., None], indices[..., None], entries)
        if self.kind == "accumulating":
            self.eligibility[marked] += probabilities[..., None]
            return
        if self.reset_other_actions:
            self.eligibility[self._envs, indices] = 0.0
        self.eligibility[marked] = probabilities[..., None].expand(entries.shape)

    def credit(self, corrections: th.Tensor) -> None:
        total = th.tensordot(corrections, self.eligibility, dims=1)
        if len(corrections) > 1:
            largest, together = self.eligibility.amax(dim=0), self.eligibility.sum(dim=0)
            total *= th.where(together > 0, largest / together, 0.0)
        self.table.values += total

    def decay(self, factor: float, ended: th.Tensor) -> None:
        # A product, as indexing by a mask would have the host wait for an accelerator.
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
    Traces for λ = 0: a trace lasts for the step that sets it, so that a step costs O(n_envs · k) and no table of
    traces is held. On an accelerator sums over environments have no fixed order, and the last digit may vary.

    :param table: the table that the traces are for
    :param n_envs: number of environments
    """

    def __init__(self, table: DenseTable, n_envs: int) -> None:
        self.n_envs = n_envs
        self.n_points = len(table.values)
        self._values = table.values.view(-1)
        self._n_actions = table.n_actions
        self._together, self._largest = self._values.new_zeros((2, len(self._values) if n_envs > 1 else 0))

    def mark(self, indices: th.Tensor, entries: th.Tensor, probabilities: th.Tensor) -> None:
        self._marked = (indices[..., None] * self._n_actions + entries).view(-1)
        self._eligibility = probabilities[..., None].expand(entries.shape).reshape(-1)

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
        """Nothing to do: none is left."""

    def clear(self) -> None:
        """Nothing to do: none is kept."""

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
        """Nothing to do: a trace of λ = 0 is over when a state is saved."""
