"""Eligibility traces as the equations have them: the reference that faster forms are held to."""

from __future__ import annotations

from typing import Any

import torch as th

from sb3_knntd.memory.table import DenseTable


class Traces:
    """
    One number for every environment and entry, all of them touched at every step, on any device.

    Environments share the table and keep their own traces. Where those of several meet at an entry, it
    moves by the mean of their TD errors, weighted by eligibility, times the largest eligibility: many
    environments in the same place do not multiply the step, and one environment alone has eq. 14.

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
        self.eligibility = table.values.new_zeros((n_envs, *table.values.shape))
        self._envs = th.arange(n_envs, device=table.values.device)[:, None]

    def mark(self, indices: th.Tensor, entries: th.Tensor, probabilities: th.Tensor) -> None:
        """
        Set the traces of the state each environment is in.

        :param indices: points, shape (n_envs, k)
        :param entries: the column of each, shape (n_envs, k)
        :param probabilities: what to set, shape (n_envs, k), the table's dtype
        """
        if self.kind == "accumulating":
            self.eligibility[self._envs, indices, entries] += probabilities
            return
        if self.reset_other_actions:
            self.eligibility[self._envs, indices] = 0.0
        self.eligibility[self._envs, indices, entries] = probabilities

    def credit(self, corrections: th.Tensor) -> None:
        """
        Q += α δ e (eq. 14).

        :param corrections: α δ of each environment, shape (n_envs,), the table's dtype
        """
        total = th.tensordot(corrections, self.eligibility, dims=1)
        if len(corrections) > 1:
            largest, together = self.eligibility.amax(dim=0), self.eligibility.sum(dim=0)
            total *= th.where(together > 0, largest / together, 0.0)
        self.table.values += total

    def decay(self, factor: float, ended: th.Tensor) -> None:
        """
        e *= γ λ (eq. 17), and no trace outlives its episode.

        :param factor: γ λ
        :param ended: whether each environment's episode has ended, shape (n_envs,), bool
        """
        self.eligibility[ended] = 0.0
        self.eligibility *= factor

    def clear(self) -> None:
        """Let go all traces."""
        self.eligibility.zero_()

    def state(self) -> dict[str, Any]:
        """
        :return: the traces that are not zero, in the form of :class:`~sb3_knntd.memory.LiveStore`
        """
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
        """
        :param state: of these traces or of a :class:`~sb3_knntd.memory.LiveStore`, for as many environments
        """
        self.clear()
        traces = (state["traces"] * state["pace"][0]).permute(2, 0, 1)
        self.eligibility[:, state["points"].to(self.eligibility.device)] = traces.to(self.eligibility)
