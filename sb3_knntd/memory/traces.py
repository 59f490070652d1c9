"""Eligibility traces: which entries of the table a TD error is credited to."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_knntd.memory.table import QTable


class Traces(nn.Module):
    """
    Traces as the equations have them: one number for every environment and entry, all of them touched at
    every step. The reference that faster forms are held to, on any device.

    Environments share the table and keep their own traces. Where those of several meet at an entry, it
    moves by the mean of their TD errors, weighted by eligibility, times the largest eligibility: many
    environments in the same place do not multiply the step, and one environment alone has eq. 14.

    :param table: the table that the traces are for
    :param n_envs: number of environments
    :param kind: ``"replacing"`` (eq. 16) or ``"accumulating"`` (eq. 15)
    :param reset_other_actions: whether a replacing trace clears those of the other actions at its points
        (line 16 of Algorithm 3)
    """

    eligibility: th.Tensor

    def __init__(self, table: QTable, n_envs: int, kind: str, reset_other_actions: bool) -> None:
        super().__init__()
        self.kind = kind
        self.reset_other_actions = reset_other_actions
        self.register_buffer("eligibility", table.values.new_zeros((n_envs, *table.values.shape)))
        self.register_buffer("_envs", th.arange(n_envs, device=table.values.device)[:, None], persistent=False)

    _envs: th.Tensor

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

    def credit(self, table: QTable, corrections: th.Tensor) -> None:
        """
        Q += α δ e (eq. 14).

        :param table: the table to change
        :param corrections: α δ of each environment, shape (n_envs,), the table's dtype
        """
        total = th.tensordot(corrections, self.eligibility, dims=1)
        if len(corrections) > 1:
            largest, together = self.eligibility.amax(dim=0), self.eligibility.sum(dim=0)
            total *= th.where(together > 0, largest / together, 0.0)
        table.values += total

    def decay(self, factor: float, ended: th.Tensor) -> None:
        """
        e *= γ λ (eq. 17), and no trace outlives its episode.

        :param factor: γ λ
        :param ended: whether each environment's episode has ended, shape (n_envs,), bool
        """
        self.eligibility *= (factor * ~ended).to(self.eligibility.dtype)[:, None, None]

    def clear(self) -> None:
        """Forget all traces."""
        self.eligibility.zero_()
