"""The entries that have a trace, and what each of them is owed."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.kernels.memory import publish, rehash, settle
from sb3_knntd.q_table.table import QTable, make_slots


class LiveStore:
    """
    Exact eligibility traces at a cost that depends on neither the table, nor λ, nor the episode's length;
    :mod:`sb3_knntd.kernels.memory` says how. While a point is live its values are kept here, and the table is
    lent them when somebody reads it.

    :param table: the table that the traces are for, on the CPU
    :param n_envs: number of environments
    """

    SMALLEST = 1024

    def __init__(self, table: QTable, n_envs: int) -> None:
        self.table = table
        self.n_envs = n_envs
        #: whether the table has the values of the live points
        self.is_published = True
        self._allocate(self.SMALLEST)
        table.lender = self

    def _allocate(self, capacity: int) -> None:
        self.points = np.empty(capacity, np.int64)
        self.entries = np.empty((capacity, self.table.n_actions, self.n_envs + 2))
        self.slots = make_slots(capacity)
        self.table.counts[1] = 0
        self.pace = np.zeros(1 + self.n_envs)
        self.pace[0] = 1.0

    @property
    def count(self) -> int:
        """Number of live points."""
        return int(self.table.counts[1])

    def memory(self) -> tuple[Any, ...]:
        """
        :return: ``memory`` of :func:`sb3_knntd.kernels.step.learn`
        """
        return (*self.table.arrays(), self.points, self.entries, self.slots, self.table.counts, self.pace)

    def reserve(self, n_points: int) -> bool:
        """
        Make room.

        :param n_points: how many points may come to life in the next step
        :return: whether the arrays have been replaced
        """
        if len(self.points) - self.count >= n_points:
            return False
        values, _, _, row_slots, _, points, entries, slots, counts, pace = self.memory()
        settle(values, row_slots, points, entries, slots, counts, pace)
        wanted = 2 * self.count + n_points
        if wanted <= len(self.points):
            return False
        self.set_state({**self.state(), "capacity": max(2 * len(self.points), wanted)})
        self.is_published = False
        return True

    def publish(self) -> None:
        """Write the values of the live points into the table."""
        if not self.is_published:
            values, _, _, row_slots, _, points, entries, _, counts, pace = self.memory()
            publish(values, row_slots, points, entries, counts, pace)
            self.is_published = True

    def forget(self) -> None:
        """Let go all traces, and what they have gained since the table was last written."""
        self._allocate(self.SMALLEST)
        self.is_published = True

    def clear(self) -> None:
        """Let go all traces."""
        self.publish()
        self.forget()

    def state(self) -> dict[str, Any]:
        """
        :return: tensors and numbers from which :meth:`set_state` goes on to the same bit
        """
        n, n_envs = self.count, self.n_envs
        entries = th.from_numpy(self.entries[:n].copy())
        return {
            "points": th.from_numpy(self.points[:n].copy()),
            "traces": entries[..., :n_envs].contiguous(),
            "share": entries[..., n_envs].contiguous(),
            "base": entries[..., n_envs + 1].contiguous(),
            "pace": th.from_numpy(self.pace.copy()),
            "capacity": len(self.points),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`state` returned, for as many environments
        """
        self._allocate(state["capacity"])
        n, n_envs = len(state["points"]), self.n_envs
        self.points[:n] = state["points"].numpy()
        self.entries[:n, :, :n_envs] = state["traces"].numpy()
        self.entries[:n, :, n_envs] = state["share"].numpy()
        self.entries[:n, :, n_envs + 1] = state["base"].numpy()
        self.pace[:] = state["pace"].numpy()
        self.table.counts[1] = n
        rehash(self.points, n, self.slots)
        self.is_published = True
