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
from sb3_knntd.kernels.traces import MOST_VISITS, TableArrays, overwrite, read_rows, rehash, write_back
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
        #: the traces when ``values`` was last brought up to date
        self._written = b""

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
                self._written = self.traces.snapshot()

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
    def counts(self) -> th.Tensor:
        """
        :return: the number of learning steps that have updated each row, up to 2³⁰, shape (n_rows,), int32
        """

    @abstractmethod
    def counts_at(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, any shape, int64
        :return: the number of learning steps that have updated each, the same shape, int32
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
        Append the rows of new points. All others keep their values and traces.

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

    visits: th.Tensor

    def __init__(self, n_points: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__(n_actions, initial_value)
        self.register_buffer("values", th.full((n_points, n_actions), self.initial_value, dtype=dtype))
        self.register_buffer("visits", th.zeros(n_points, dtype=th.int32))

    @property
    def n_visited(self) -> int:
        return int((self.visits > 0).sum())

    def visit(self, indices: th.Tensor) -> None:
        """
        Count a learning step that updates these points.

        :param indices: point indices, any shape, int64; a point that is named twice is updated by two steps
        """
        points = indices.reshape(-1)
        self.visits.index_add_(0, points, (self.visits[points] < MOST_VISITS).int())

    def counts(self) -> th.Tensor:
        return self.visits

    def counts_at(self, indices: th.Tensor) -> th.Tensor:
        return self.visits[indices]

    def entries(self) -> th.Tensor:
        self._write_back()
        return self.values

    def points(self) -> None:
        return None

    def rows(self, indices: th.Tensor) -> th.Tensor:
        if is_traced() and self.traces.count and self._written != self.traces.snapshot():
            raise ValueError(
                "the table has been learned into since its tensor was last brought up to date, and what is traced or "
                "exported now would be of before: call model.policy.eval() first"
            )
        if is_traced() or not self.traces.count:
            with self.lock:
                return self.values[indices]
        return super().rows(indices)

    def _reserve_rows(self, n_points: int) -> bool:
        return False

    def add_rows(self, values: th.Tensor) -> None:
        with self.lock:
            grown = th.cat((self.values, values.to(self.values)))
            self.values, self.visits = grown, th.cat((self.visits, self.visits.new_zeros(len(values))))
            self.version += 1

    def has_visited(self, points: th.Tensor) -> th.Tensor:
        has_visited: th.Tensor = self.counts()[points] > 0
        return has_visited

    def write(self, points: th.Tensor, values: th.Tensor) -> None:
        with self.lock:
            self.drop_traces()
            self.values[points] = values.to(self.values)

    def carry_over(self, regridding: Regridding) -> None:
        with self.lock:
            old = self.entries()
            values, visits = th.empty_like(old), th.empty_like(self.visits)
            for points in th.arange(len(old), device=old.device).split(BATCH):
                sources = regridding.sources(points)
                values[points] = self._carried(old[sources[0]], sources)
                visits[points] = self.visits[sources[0][:, 0]]
            self.forget_traces()
            self.values.copy_(values)
            self.visits.copy_(visits)

    def resize(self, n_points: int) -> None:
        """
        Change the number of rows. If it changes, all entries are set to the initial value.

        :param n_points: number of rows
        """
        if n_points != len(self.values):
            with self.lock:
                self.forget_traces()
                self.values = self.values.new_full((n_points, self.n_actions), self.initial_value)
                self.visits = self.visits.new_zeros(n_points)

    def arrays(self) -> TableArrays:
        return TableArrays(
            values=self.values.numpy(),
            visits=self.visits.numpy(),
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
            state_dict = _counted(state_dict, prefix, len(self.visits))
            self.forget_traces()
            super()._load_from_state_dict(state_dict, prefix, *args)


def _counted(state_dict: Any, prefix: str, n_points: int) -> Any:
    """The state with checked visits. Versions that did not count them saved a bit for each point: one visit or none."""
    state = dict(state_dict)
    bits = state.pop(prefix + "visited", None)
    if isinstance(bits, th.Tensor) and bits.dtype == th.uint8:
        visited = np.unpackbits(bits.cpu().numpy(), bitorder="little")[:n_points]
        state.setdefault(prefix + "visits", th.from_numpy(visited.astype(np.int32)))
    if prefix + "visits" in state:
        checked_tensor(state, prefix + "visits", (None,), th.int32, 0)
    return state


class GrowingTable(DenseTable):
    """
    A table to which rows are added while learning goes on: the traces stay. Its arrays have free rows, which hold the
    initial value. The first ``n_neighbors`` rows can be read before their points come.

    :param n_neighbors: number of rows, in use or free, that there always are
    :param n_actions: number of columns
    :param initial_value: initial value of all entries
    :param dtype: floating type of the entries
    """

    SMALLEST = 64

    def __init__(self, n_neighbors: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__(max(self.SMALLEST, n_neighbors), n_actions, initial_value, dtype)
        self.n_neighbors = n_neighbors
        #: number of rows in use
        self.n_rows = 0

    @property
    def n_visited(self) -> int:
        return int((self.counts() > 0).sum())

    def entries(self) -> th.Tensor:
        return super().entries()[: self.n_rows]

    def counts(self) -> th.Tensor:
        return self.visits[: self.n_rows]

    def add_rows(self, values: th.Tensor) -> None:
        values = values.to(self.values)
        with self.lock:
            n_rows = self.n_rows + len(values)
            if n_rows > len(self.values):
                self._write_back()
                self._set(self.values[: self.n_rows], self.counts(), 2 * n_rows)
            for row, new in enumerate(values, self.n_rows):
                self.visits[row] = 0
                if self.values.is_cpu:
                    overwrite(row, new.numpy(), self.arrays(), self.traces.arrays)
                else:
                    self.values[row] = new
            self.n_rows = n_rows

    def merge_rows(self, moved: th.Tensor) -> None:
        """
        Give each point the mean of the values of the points that became it, of the visited ones if there are any, and
        the sum of their visits. All traces are dropped.

        :param moved: the new index of each point, shape (n_rows,), int64, counted from 0 without gaps
        """
        with self.lock:
            values, visits = self.entries(), self.counts()
            n_rows = int(moved.max()) + 1
            sums = self._sums(moved, visits.long()[:, None], n_rows)[:, 0]
            # Where no point was visited, all count.
            counting = ((visits > 0) | (sums[moved] == 0)).to(values.dtype)[:, None]
            means = self._sums(moved, counting * values, n_rows) / self._sums(moved, counting, n_rows)
            self.forget_traces()
            # As many rows as before: another thread may be about to read a point by its old index.
            self._set(means, sums.clamp(max=MOST_VISITS).int(), len(self.values))
            self.n_rows = n_rows

    def resize(self, n_points: int) -> None:
        """
        Change the number of rows in use. All entries are set to the initial value.

        :param n_points: number of rows
        """
        with self.lock:
            nothing = self.values.new_full((n_points, self.n_actions), self.initial_value)
            self.forget_traces()
            self._set(nothing, self.visits.new_zeros(n_points), 2 * n_points)
            self.n_rows = n_points

    @staticmethod
    def _sums(groups: th.Tensor, rows: th.Tensor, n_groups: int) -> th.Tensor:
        """Sums over the rows of each group."""
        return rows.new_zeros((n_groups, rows.shape[1])).index_add_(0, groups, rows)

    def _set(self, values: th.Tensor, visits: th.Tensor, n_rows: int) -> None:
        """Take new arrays of ``n_rows`` rows or more that begin with these."""
        n_rows = max(n_rows, self.SMALLEST, self.n_neighbors)
        grown = values.new_full((n_rows, self.n_actions), self.initial_value)
        grown[: len(values)] = values
        counted = visits.new_zeros(n_rows)
        counted[: len(visits)] = visits
        self.values, self.visits = grown, counted
        self.version += 1

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        with self.lock:
            destination[prefix + "values"] = self.entries().clone()
            destination[prefix + "visits"] = self.counts().clone()

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        if not {prefix + "values", prefix + "visits"} <= set(state_dict):
            # torch reports what is missing.
            super()._load_from_state_dict(state_dict, prefix, *args)
            return
        values = checked_tensor(state_dict, prefix + "values", (self.n_rows, self.n_actions))
        visits = checked_tensor(state_dict, prefix + "visits", (self.n_rows,), th.int32, 0)
        with self.lock:
            self.forget_traces()
            self._set(values.to(self.values), visits.to(self.visits.device), 2 * self.n_rows)


class _Rows(NamedTuple):
    """
    The rows of a hashed table.

    :param values: shape (capacity, n_actions)
    :param points: the point of each row, shape (capacity,), int64
    :param visits: the number of learning steps that have updated each row, shape (capacity,), int32
    :param slots: hash from points to rows
    :param n_used: number of rows in use, shape (1,), int64
    """

    values: th.Tensor
    points: th.Tensor
    visits: th.Tensor
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
        self._rows = self._made_of(no_points, no_values, th.empty(0, dtype=th.int32), self.SMALLEST)

    def _made_of(self, points: th.Tensor, values: th.Tensor, visits: th.Tensor, capacity: int) -> _Rows:
        """Allocate ``capacity`` rows and fill the first ones."""
        n = len(points)
        rows = _Rows(
            th.full((capacity, self.n_actions), self.initial_value, dtype=values.dtype),
            th.full((capacity,), -1, dtype=th.int64),
            th.zeros(capacity, dtype=th.int32),
            make_slots(capacity),
            np.array([n]),
        )
        rows.values[:n] = values
        rows.points[:n] = points
        rows.visits[:n] = visits
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

    def counts(self) -> th.Tensor:
        return self._rows.visits[: self.n_visited]

    def counts_at(self, indices: th.Tensor) -> th.Tensor:
        if not self.n_visited:
            return th.zeros_like(indices, dtype=th.int32)
        points, order = self.points().sort()
        nearest = th.searchsorted(points, indices.contiguous()).clamp(max=len(points) - 1)
        return self.counts()[order[nearest]] * (points[nearest] == indices)

    def points(self) -> th.Tensor:
        return self._rows.points[: self.n_visited]

    def rows(self, indices: th.Tensor) -> th.Tensor:
        if is_traced():
            raise ValueError(
                "a policy with a hashed table cannot be traced or exported by torch's own functions: its rows are "
                "found by compiled code. Call model.policy.export(path, 'torchscript') or (path, 'torch_export') "
                "instead, or make the model with policy_kwargs={'table': 'dense'}"
            )
        return super().rows(indices)

    def _reserve_rows(self, n_points: int) -> bool:
        rows, n = self._rows, self.n_visited
        if len(rows.values) - n >= n_points:
            return False
        capacity = max(2 * len(rows.values), n + n_points)
        self._rows = self._made_of(rows.points[:n], rows.values[:n], rows.visits[:n], capacity)
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
            visits = th.cat((self.counts()[others], self.counts_at(points)))
            self._refill(th.cat((self.points()[others], points)), th.cat((kept, values.to(kept))), visits)

    def carry_over(self, regridding: Regridding) -> None:
        with self.lock:
            points = th.cat([regridding.targets(part) for part in self.points().split(BATCH)]).unique()
            sources = [regridding.sources(part) for part in points.split(BATCH)]
            values = th.cat([self._carried(self.rows(each[0]), each) for each in sources])
            visits = th.cat([self.counts_at(each[0][:, 0]) for each in sources])
            self._refill(points, values, visits)

    def arrays(self) -> TableArrays:
        rows = self._rows
        return TableArrays(
            values=rows.values.numpy(),
            visits=rows.visits.numpy(),
            row_points=rows.points.numpy(),
            row_slots=rows.slots,
            n_rows=rows.n_used,
            initial_value=self.initial_value,
        )

    def _refill(self, points: th.Tensor, values: th.Tensor, visits: th.Tensor) -> None:
        """Replace all rows by these."""
        rows = self._made_of(points, values, visits, max(self.SMALLEST, len(points)))
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
            destination[prefix + "row_visits"] = self.counts().clone()

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        with self.lock:
            points = checked_points(state_dict, prefix + "row_points", self.n_points)
            values = checked_tensor(state_dict, prefix + "values", (len(points), self.n_actions))
            # Versions that did not count visits did not save them, and every row was visited.
            visits = th.ones(len(points), dtype=th.int32)
            if prefix + "row_visits" in state_dict:
                visits = checked_tensor(state_dict, prefix + "row_visits", (len(points),), th.int32, 0)
            self._refill(points, values.to(self.values.dtype), visits)
