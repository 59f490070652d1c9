"""The Q-table: a row for each perception point, a column for each action."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.state_checks import checked_points, checked_tensor
from sb3_knntd.common.tracing import is_traced
from sb3_knntd.kernels.traces import TableArrays, read_rows, rehash, write_back
from sb3_knntd.q_table.active_traces import ActiveTraces, make_slots

#: Number of points whose values are carried over at a time.
BATCH = 2**16


class Regridding(Protocol):
    """A map between the old and the new points, see :class:`~sb3_knntd.perception.perceiver.Regridding`."""

    def sources(self, indices: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The nearest old points of each new point, and their weights."""

    def targets(self, indices: th.Tensor) -> th.Tensor:
        """The nearest new point of each old point."""


class QTable(nn.Module, ABC):
    """
    Base class of Q-tables.

    Entries can be read from any thread at any time, also while a learner updates them: both hold :attr:`lock`. The
    values of points with an eligibility trace are stored in ``traces`` until the trace has decayed; all methods
    that read the table read them from there.

    :param n_actions: number of columns
    :param initial_value: initial value of all entries
    """

    values: th.Tensor

    def __init__(self, n_actions: int, initial_value: float) -> None:
        super().__init__()
        self.n_actions = n_actions
        self.initial_value = float(initial_value)
        #: hold this lock while entries are read or written
        self.lock = threading.RLock()
        #: incremented whenever arrays have been replaced or set to other values
        self.version = 0
        self.traces = ActiveTraces(n_actions, n_envs=1, capacity=0)

    def __getstate__(self) -> dict[str, Any]:
        # A lock cannot be copied or pickled.
        return {name: value for name, value in self.__dict__.items() if name != "lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.lock = threading.RLock()

    @property
    @abstractmethod
    def n_visited(self) -> int:
        """Number of points that have been updated by learning."""

    def start_traces(self, n_envs: int) -> ActiveTraces:
        """
        Drop all traces, and start new ones.

        :param n_envs: number of environments
        :return: the new traces, which this table reads from now on
        """
        with self.lock:
            self._write_back()
            self.traces = ActiveTraces(self.n_actions, n_envs)
            self.version += 1
            return self.traces

    def drop_traces(self) -> None:
        """Drop all traces; the entries keep their current values."""
        with self.lock:
            self._write_back()
            self.forget_traces()

    def train(self, mode: bool = True) -> QTable:
        """
        Set training or evaluation mode, as in torch, and bring ``values`` up to date. Before exporting a policy,
        call ``eval()``.

        :param mode: whether to train
        :return: the table
        """
        self._write_back()
        return super().train(mode)

    def _write_back(self) -> None:
        """Bring ``values`` up to date. A learner does not read the entries written here before it overwrites them."""
        if self.traces.count:
            with self.lock:
                write_back(self.arrays(), self.traces.arrays)

    def forget_traces(self) -> None:
        """Drop all traces and the values of the entries with a trace."""
        self.traces.clear()
        self.version += 1

    @abstractmethod
    def entries(self) -> th.Tensor:
        """
        :return: all rows, up to date, shape (n_rows, n_actions)
        """

    @abstractmethod
    def points(self) -> th.Tensor | None:
        """
        :return: the point of each row, shape (n_rows,), int64; ``None`` if row i is that of point i
        """

    def rows(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, shape (batch, k), int64
        :return: their values, up to date, shape (batch, k, n_actions)
        """
        rows = np.empty((indices.numel(), self.n_actions), self.values.numpy().dtype)
        with self.lock:
            read_rows(indices.reshape(-1).numpy(), self.arrays(), self.traces.arrays, rows)
        return th.from_numpy(rows).reshape(*indices.shape, self.n_actions)

    def reserve(self, n_points: int) -> None:
        """
        Reserve capacity for the next step.

        :param n_points: largest number of new points in the next step
        """
        self.make_room(self.traces, n_points)

    def make_room(self, traces: ActiveTraces, n_points: int) -> None:
        """
        Reserve capacity in the table and in traces.

        :param traces: ``traces``, or other traces of this table
        :param n_points: largest number of new points in the next step
        """
        if self._reserve_rows(n_points) | traces.reserve(n_points, self.arrays()):
            self.version += 1

    @abstractmethod
    def _reserve_rows(self, n_points: int) -> bool:
        """Reserve rows for new points; whether arrays have been replaced."""

    @abstractmethod
    def add_rows(self, values: th.Tensor) -> None:
        """
        Append the rows of new points.

        :param values: their values, shape (n_new, n_actions)
        """

    @abstractmethod
    def has_visited(self, points: th.Tensor) -> th.Tensor:
        """
        :param points: points, shape (n,), int64
        :return: whether each has been updated by learning, shape (n,), bool
        """

    @abstractmethod
    def write(self, points: th.Tensor, values: th.Tensor) -> None:
        """
        Set the rows of some points. All traces are dropped.

        :param points: different points, shape (n,), int64
        :param values: their values, shape (n, n_actions)
        """

    @abstractmethod
    def arrays(self) -> TableArrays:
        """
        :return: the arrays for the kernels, which share memory with this table
        """

    @abstractmethod
    def carry_over(self, regridding: Regridding) -> None:
        """
        Set each point to the value that the table had at the point's new position. All traces are dropped.

        :param regridding: map between the old and the new points
        """

    @staticmethod
    def _carried(values: th.Tensor, sources: tuple[th.Tensor, th.Tensor]) -> th.Tensor:
        """The weighted mean over k rows ``values``, shape (n, k, n_actions), at ``sources``; shape (n, n_actions)."""
        return (sources[1][..., None].to(values.dtype) * values).sum(dim=1)

    def _apply(self, fn: Any, recurse: bool = True) -> QTable:
        self.drop_traces()
        super()._apply(fn, recurse)
        self.version += 1
        return self


class DenseTable(QTable):
    """
    A table with a row for every point.

    :param n_points: number of rows
    :param n_actions: number of columns
    :param initial_value: initial value of all entries
    :param dtype: floating type of the entries
    """

    visited: th.Tensor

    def __init__(self, n_points: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__(n_actions, initial_value)
        self.register_buffer("values", th.full((n_points, n_actions), self.initial_value, dtype=dtype))
        self.register_buffer("visited", self._no_visits(n_points))

    @staticmethod
    def _no_visits(n_points: int) -> th.Tensor:
        """A bit for each row: whether it has been updated by learning; and one spare byte at the end."""
        return th.zeros((n_points + 7) // 8 + 1, dtype=th.uint8)

    @property
    def n_visited(self) -> int:
        return int(np.unpackbits(self.visited.cpu().numpy()[:-1]).sum())

    def visit(self, indices: th.Tensor) -> None:
        """
        Mark points as visited.

        :param indices: point indices, any shape, int64
        """
        self._visit(self.visited, indices)

    @staticmethod
    def _visit(visited: th.Tensor, indices: th.Tensor) -> None:
        byte, bit = indices.reshape(-1) >> 3, indices.reshape(-1) & 7
        for each in range(8):
            # Concurrent writes to a byte write the same value; points with another bit write to the spare byte.
            at = th.where(bit == each, byte, len(visited) - 1)
            visited[at] = visited[at] | (1 << each)

    def entries(self) -> th.Tensor:
        self._write_back()
        return self.values

    def points(self) -> None:
        return None

    def rows(self, indices: th.Tensor) -> th.Tensor:
        if is_traced() or not self.traces.count:
            with self.lock:
                return self.values[indices]
        return super().rows(indices)

    def _reserve_rows(self, n_points: int) -> bool:
        return False

    def add_rows(self, values: th.Tensor) -> None:
        with self.lock:
            self.drop_traces()
            n_points = len(self.values) + len(values)
            grown = th.cat((self.values, values.to(self.values)))
            visited = self._no_visits(n_points).to(self.values.device)
            visited[: len(self.visited) - 1] = self.visited[:-1]
            self.values, self.visited = grown, visited
            self.version += 1

    def has_visited(self, points: th.Tensor) -> th.Tensor:
        return self._visits()[points]

    def write(self, points: th.Tensor, values: th.Tensor) -> None:
        with self.lock:
            self.drop_traces()
            self.values[points] = values.to(self.values)

    def carry_over(self, regridding: Regridding) -> None:
        with self.lock:
            old, was_visited = self.entries(), self._visits()
            values, visited = th.empty_like(old), th.zeros_like(self.visited)
            for points in th.arange(len(old), device=old.device).split(BATCH):
                sources = regridding.sources(points)
                values[points] = self._carried(old[sources[0]], sources)
                self._visit(visited, points[was_visited[sources[0][:, 0]]])
            self.forget_traces()
            self.values.copy_(values)
            self.visited.copy_(visited)

    def resize(self, n_points: int) -> None:
        """
        Change the number of rows. If it changes, all entries are set to the initial value.

        :param n_points: number of rows
        """
        if n_points != len(self.values):
            with self.lock:
                self.forget_traces()
                self.values = self.values.new_full((n_points, self.n_actions), self.initial_value)
                self.visited = self._no_visits(n_points).to(self.values.device)

    def _visits(self) -> th.Tensor:
        """Whether each row has been updated by learning, shape (n_points,), bool."""
        bits = th.arange(8, device=self.visited.device, dtype=th.uint8)
        return ((self.visited[:-1, None] >> bits) & 1).bool().flatten()[: len(self.values)]

    def arrays(self) -> TableArrays:
        return TableArrays(
            values=self.values.numpy(),
            visited=self.visited.numpy(),
            row_points=np.empty(0, np.int64),
            row_slots=np.empty((0, 2), np.int64),
            n_rows=np.zeros(1, np.int64),
            initial_value=self.initial_value,
        )

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        with self.lock:
            self._write_back()
            super()._save_to_state_dict(destination, prefix, keep_vars)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        with self.lock:
            # Missing tensors and wrong shapes are reported by torch.
            if prefix + "values" in state_dict:
                checked_tensor(state_dict, prefix + "values", (None, None))
            self.forget_traces()
            super()._load_from_state_dict(state_dict, prefix, *args)


class _Rows(NamedTuple):
    """
    The rows of a hashed table.

    :param values: shape (capacity, n_actions)
    :param points: the point of each row, shape (capacity,), int64
    :param slots: hash from points to rows
    :param n_used: number of rows in use, shape (1,), int64
    """

    values: th.Tensor
    points: th.Tensor
    slots: np.ndarray
    n_used: np.ndarray


class HashedTable(QTable):
    """
    A table with a row for every visited point; all other points have the initial value. For lattices larger than
    memory, on the CPU only.

    :param n_points: number of points of the lattice
    :param n_actions: number of columns
    :param initial_value: initial value of all entries
    :param dtype: floating type of the entries
    """

    SMALLEST = 1024

    def __init__(self, n_points: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__(n_actions, initial_value)
        self.n_points = n_points
        no_points, no_values = th.empty(0, dtype=th.int64), th.empty((0, n_actions), dtype=dtype)
        # Replaced as a whole, so that an interruption leaves all rows unchanged.
        self._rows = self._made_of(no_points, no_values, self.SMALLEST)

    def _made_of(self, points: th.Tensor, values: th.Tensor, capacity: int) -> _Rows:
        """Allocate ``capacity`` rows and fill the first ones."""
        n = len(points)
        rows = _Rows(
            th.full((capacity, self.n_actions), self.initial_value, dtype=values.dtype),
            th.full((capacity,), -1, dtype=th.int64),
            make_slots(capacity),
            np.array([n]),
        )
        rows.values[:n] = values
        rows.points[:n] = points
        rehash(rows.points.numpy(), n, rows.slots)
        return rows

    @property
    def values(self) -> th.Tensor:  # type: ignore[override]
        """The rows in use, followed by unused ones, shape (capacity, n_actions)."""
        return self._rows.values

    @property
    def n_visited(self) -> int:
        return int(self._rows.n_used[0])

    def entries(self) -> th.Tensor:
        with self.lock:
            self._write_back()
            return self.values[: self.n_visited]

    def points(self) -> th.Tensor:
        return self._rows.points[: self.n_visited]

    def rows(self, indices: th.Tensor) -> th.Tensor:
        if is_traced():
            raise ValueError(
                "a policy with a hashed table cannot be traced or exported: its rows are found by compiled code. Make "
                "the model with policy_kwargs={'table': 'dense'}, and fewer points if it would not fit; predict works "
                "with every table"
            )
        return super().rows(indices)

    def _reserve_rows(self, n_points: int) -> bool:
        rows, n = self._rows, self.n_visited
        if len(rows.values) - n >= n_points:
            return False
        capacity = max(2 * len(rows.values), n + n_points)
        self._rows = self._made_of(rows.points[:n], rows.values[:n], capacity)
        return True

    def add_rows(self, values: th.Tensor) -> None:
        raise ValueError("points can be added to a dense table only: policy_kwargs={'table': 'dense'}")

    def has_visited(self, points: th.Tensor) -> th.Tensor:
        return th.isin(points, self.points())

    def write(self, points: th.Tensor, values: th.Tensor) -> None:
        with self.lock:
            self._write_back()
            others = ~th.isin(self.points(), points)
            kept = self.values[: self.n_visited][others]
            self._refill(th.cat((self.points()[others], points)), th.cat((kept, values.to(kept))))

    def carry_over(self, regridding: Regridding) -> None:
        with self.lock:
            points = th.cat([regridding.targets(part) for part in self.points().split(BATCH)]).unique()
            values = th.cat([self._carried(self.rows(s[0]), s) for s in map(regridding.sources, points.split(BATCH))])
            self._refill(points, values)

    def arrays(self) -> TableArrays:
        rows = self._rows
        return TableArrays(
            values=rows.values.numpy(),
            visited=np.empty(0, np.uint8),
            row_points=rows.points.numpy(),
            row_slots=rows.slots,
            n_rows=rows.n_used,
            initial_value=self.initial_value,
        )

    def _refill(self, points: th.Tensor, values: th.Tensor) -> None:
        """Replace all rows by these."""
        rows = self._made_of(points, values, max(self.SMALLEST, len(points)))
        self.forget_traces()
        self._rows = rows

    def _apply(self, fn: Any, recurse: bool = True) -> HashedTable:
        super()._apply(fn, recurse)
        values = fn(self.values)
        if not values.is_cpu:
            raise ValueError("a hashed table is on the CPU only: give policy_kwargs={'table': 'dense'}")
        self._rows = self._rows._replace(values=values)
        return self

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        with self.lock:
            destination[prefix + "values"] = self.entries().clone()
            destination[prefix + "row_points"] = self.points().clone()

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        with self.lock:
            points = checked_points(state_dict, prefix + "row_points", self.n_points)
            values = checked_tensor(state_dict, prefix + "values", (len(points), self.n_actions))
            self._refill(points, values.to(self.values.dtype))
