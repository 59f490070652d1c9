"""The eligibility traces of the compiled learner, and the values of the entries that have a trace."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_knntd.kernels.traces import TableArrays, TraceArrays, flush, rehash

#: Initial capacity, active points.
SMALLEST_CAPACITY = 1024


class ActiveTraces:
    """
    Exact eligibility traces whose cost is independent of the size of the table, λ and the length of the episode, see
    :mod:`sb3_knntd.kernels.traces`. While a point is active, its values are stored here.

    :param n_actions: number of columns of the table
    :param n_envs: number of environments
    :param capacity: initial capacity, active points
    """

    #: replaced as a whole, so that an interruption leaves all arrays unchanged
    arrays: TraceArrays

    def __init__(self, n_actions: int, n_envs: int, capacity: int = SMALLEST_CAPACITY) -> None:
        self.n_actions = n_actions
        self.n_envs = n_envs
        self.arrays = self._empty(capacity)

    def _empty(self, capacity: int) -> TraceArrays:
        clock = np.zeros(1 + self.n_envs)
        clock[0] = 1.0
        return TraceArrays(
            active_points=np.empty(capacity, np.int64),
            active_entries=np.empty((capacity, self.n_actions, self.n_envs + 2)),
            active_slots=make_slots(capacity),
            n_active=np.zeros(1, np.int64),
            clock=clock,
        )

    @property
    def count(self) -> int:
        """Number of active points."""
        return int(self.arrays.n_active[0])

    @property
    def capacity(self) -> int:
        """Number of points that the arrays can hold."""
        return len(self.arrays.active_points)

    def reserve(self, n_points: int, table: TableArrays) -> bool:
        """
        Reserve capacity. Points whose traces have decayed are dropped first.

        :param n_points: largest number of points that may become active in the next step
        :param table: the table that the values of dropped points are written to
        :return: whether the arrays have been replaced
        """
        if self.capacity - self.count >= n_points:
            return False
        flush(table, self.arrays)
        wanted = 2 * self.count + n_points
        if wanted <= self.capacity:
            return False
        self.arrays = self._made_of(self.state(), max(2 * self.capacity, wanted))
        return True

    def clear(self) -> None:
        """Drop all traces, and the values of the entries with a trace."""
        self.arrays = self._empty(SMALLEST_CAPACITY)

    def snapshot(self) -> bytes:
        """
        :return: what the values of the entries with a trace follow from; it differs whenever one of them has changed
        """
        n, arrays = self.count, self.arrays
        parts = (arrays.active_points[:n], arrays.active_entries[:n], arrays.clock)
        return b"".join(part.tobytes() for part in parts)

    def state(self) -> dict[str, Any]:
        """
        :return: tensors and numbers from which :meth:`set_state` restores the traces exactly
        """
        n, n_envs, arrays = self.count, self.n_envs, self.arrays
        entries = th.from_numpy(arrays.active_entries[:n].copy())
        return {
            "points": th.from_numpy(arrays.active_points[:n].copy()),
            "traces": entries[..., :n_envs].contiguous(),
            "share": entries[..., n_envs].contiguous(),
            "base": entries[..., n_envs + 1].contiguous(),
            "pace": th.from_numpy(arrays.clock.copy()),
            "capacity": self.capacity,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """
        :param state: the return value of :meth:`state`, for the same number of environments
        """
        self.arrays = self._made_of(state, state["capacity"])

    def _made_of(self, state: dict[str, Any], capacity: int) -> TraceArrays:
        arrays, n, n_envs = self._empty(capacity), len(state["points"]), self.n_envs
        arrays.active_points[:n] = state["points"].numpy()
        arrays.active_entries[:n, :, :n_envs] = state["traces"].numpy()
        arrays.active_entries[:n, :, n_envs] = state["share"].numpy()
        arrays.active_entries[:n, :, n_envs + 1] = state["base"].numpy()
        arrays.clock[:] = state["pace"].numpy()
        arrays.n_active[0] = n
        rehash(arrays.active_points, n, arrays.active_slots)
        return arrays


def make_slots(capacity: int) -> np.ndarray:
    """
    :param capacity: number of points that the hash must hold
    :return: an empty hash, at most half full with that many points, see :mod:`sb3_knntd.kernels.traces`
    """
    return np.full((1 << max(2 * capacity - 1, 1).bit_length(), 2), -1, np.int64)
