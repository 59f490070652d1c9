"""The Q-table: one row a perception point, one column an action."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.state_checks import checked_points, checked_tensor
from sb3_knntd.common.tracing import is_traced
from sb3_knntd.kernels.memory import find_rows, rehash


class Lender(Protocol):
    """Holds newer values of some rows than the table does."""

    def publish(self) -> None:
        """Write them into the table."""

    def forget(self) -> None:
        """Drop them: the table has been given other values."""


class Regridding(Protocol):
    """From the points where they were to where they are, see :class:`~sb3_knntd.perception.perceiver.Regridding`."""

    def sources(self, indices: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Of points as they are, the points they were nearest to, and how much each of these counts."""

    def targets(self, indices: th.Tensor) -> th.Tensor:
        """Of points as they were, the point that is now nearest to each."""


#: Points whose values are carried over in one go.
BATCH = 2**16


class QTable(nn.Module, ABC):
    """
    What every table does. A learner may keep newer values of some rows; it gives itself as ``lender``, and
    whatever reads the table here asks it for them first.

    :param n_actions: number of columns
    :param initial_value: what every entry is at the start
    """

    values: th.Tensor

    def __init__(self, n_actions: int, initial_value: float) -> None:
        super().__init__()
        self.n_actions = n_actions
        self.initial_value = float(initial_value)
        self.lender: Lender | None = None
        #: number of rows made, number of live points: see :mod:`sb3_knntd.kernels.memory`
        self.counts = np.zeros(2, np.int64)

    @property
    @abstractmethod
    def n_visited(self) -> int:
        """Number of points that have been learned at."""

    def sync(self) -> None:
        """Bring the table up to date with its learner."""
        if self.lender is not None:
            self.lender.publish()

    def _forget_lent(self) -> None:
        if self.lender is not None:
            self.lender.forget()

    def train(self, mode: bool = True) -> QTable:
        """
        As in torch. It brings the table up to date besides: to be exported with its values, a policy is put in
        evaluation mode first.

        :param mode: whether to train
        :return: the table
        """
        self.sync()
        return super().train(mode)

    @abstractmethod
    def entries(self) -> th.Tensor:
        """
        :return: the rows there are, up to date, shape (n_rows, n_actions)
        """

    @abstractmethod
    def points(self) -> th.Tensor | None:
        """
        :return: the point of each row, shape (n_rows,), int64; ``None`` if the points are the rows
        """

    @abstractmethod
    def rows(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, shape (batch, k), int64
        :return: their values, up to date, shape (batch, k, n_actions)
        """

    @abstractmethod
    def reserve(self, n_points: int) -> bool:
        """
        Make room.

        :param n_points: how many new points there may be in the next step
        :return: whether the arrays have been replaced
        """

    @abstractmethod
    def arrays(self) -> tuple[Any, ...]:
        """
        :return: values, visited, row_points, row_slots and initial of :mod:`sb3_knntd.kernels.memory`, sharing
            memory with this table
        """

    @abstractmethod
    def carry_over(self, regridding: Regridding) -> None:
        """
        Give each point the values that the table had where the point now is. A learner's traces are let go.

        :param regridding: where the points were, and where they are
        """

    @staticmethod
    def _carried(values: th.Tensor, sources: tuple[th.Tensor, th.Tensor]) -> th.Tensor:
        """The mean of the rows at ``sources``, rows of shape (n, k, n_actions), shape (n, n_actions)."""
        return (sources[1][..., None].to(values.dtype) * values).sum(dim=1)

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        self.sync()
        super()._save_to_state_dict(destination, prefix, keep_vars)


class DenseTable(QTable):
    """
    A row for every point.

    :param n_points: number of rows
    :param n_actions: number of columns
    :param initial_value: what every entry is at the start
    :param dtype: floating type of the entries
    """

    visited: th.Tensor

    def __init__(self, n_points: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__(n_actions, initial_value)
        self.register_buffer("values", th.full((n_points, n_actions), self.initial_value, dtype=dtype))
        # Which rows have been learned at, a bit each, and one byte more than there are rows for.
        self.register_buffer("visited", th.zeros((n_points + 7) // 8 + 1, dtype=th.uint8))

    @property
    def n_visited(self) -> int:
        return int(np.unpackbits(self.visited.cpu().numpy()[:-1]).sum())

    def visit(self, indices: th.Tensor) -> None:
        """
        Note that points are learned at.

        :param indices: points, any shape, int64
        """
        byte, bit = indices.reshape(-1) >> 3, indices.reshape(-1) & 7
        for each in range(8):
            # All that write to a byte at once write the same; points of another bit write to the byte to spare.
            at = th.where(bit == each, byte, len(self.visited) - 1)
            self.visited[at] = self.visited[at] | (1 << each)

    def entries(self) -> th.Tensor:
        self.sync()
        return self.values

    def points(self) -> None:
        return None

    def rows(self, indices: th.Tensor) -> th.Tensor:
        self.sync()
        return self.values[indices]

    def reserve(self, n_points: int) -> bool:
        return False

    def carry_over(self, regridding: Regridding) -> None:
        old, was_visited = self.entries().clone(), self._visits()
        self._forget_lent()
        self.visited.zero_()
        for points in th.arange(len(old), device=old.device).split(BATCH):
            sources = regridding.sources(points)
            self.values[points] = self._carried(old[sources[0]], sources)
            self.visit(points[was_visited[sources[0][:, 0]]])

    def _visits(self) -> th.Tensor:
        """Which rows have been learned at, shape (n_points,), bool."""
        bits = th.arange(8, device=self.visited.device, dtype=th.uint8)
        return ((self.visited[:-1, None] >> bits) & 1).bool().flatten()[: len(self.values)]

    def arrays(self) -> tuple[Any, ...]:
        no_points, no_slots = np.empty(0, np.int64), np.empty((0, 2), np.int64)
        return self.values.numpy(), self.visited.numpy(), no_points, no_slots, self.initial_value

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        # What is missing or has another shape torch tells of.
        if prefix + "values" in state_dict:
            checked_tensor(state_dict, prefix + "values", (None, None))
        self._forget_lent()
        super()._load_from_state_dict(state_dict, prefix, *args)


class HashedTable(QTable):
    """
    A row for every point that has been learned at, made then; all others are worth the initial value. For
    lattices larger than memory. On the CPU only.

    :param n_points: number of points that may get a row
    :param n_actions: number of columns
    :param initial_value: what every entry is at the start
    :param dtype: floating type of the entries
    """

    SMALLEST = 1024

    row_points: th.Tensor

    def __init__(self, n_points: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__(n_actions, initial_value)
        self.n_points = n_points
        self.register_buffer("values", th.empty((0, n_actions), dtype=dtype))
        self.register_buffer("row_points", th.empty(0, dtype=th.int64))
        self._resize(self.SMALLEST)

    @property
    def n_visited(self) -> int:
        return int(self.counts[0])

    def entries(self) -> th.Tensor:
        self.sync()
        return self.values[: self.n_visited]

    def points(self) -> th.Tensor:
        return self.row_points[: self.n_visited]

    def rows(self, indices: th.Tensor) -> th.Tensor:
        if is_traced():
            raise ValueError(
                "a policy with a hashed table cannot be traced or exported: its rows are found by compiled code. Make "
                "the model with policy_kwargs={'table': 'dense'}, and fewer points if it would not fit; predict works "
                "with any"
            )
        self.sync()
        found = np.empty(indices.numel(), np.int64)
        find_rows(indices.reshape(-1).numpy(), self._slots, found)
        rows = th.from_numpy(found).reshape(indices.shape)
        return th.where((rows >= 0)[..., None], self.values[rows.clamp(min=0)], self.initial_value)

    def reserve(self, n_points: int) -> bool:
        if len(self.values) - self.n_visited >= n_points:
            return False
        self._resize(max(2 * len(self.values), self.n_visited + n_points))
        return True

    def carry_over(self, regridding: Regridding) -> None:
        self.sync()
        points = th.cat([regridding.targets(part) for part in self.points().split(BATCH)]).unique()
        values = th.cat([self._carried(self.rows(s[0]), s) for s in map(regridding.sources, points.split(BATCH))])
        self._refill(points, values)

    def arrays(self) -> tuple[Any, ...]:
        no_bits = np.empty(0, np.uint8)
        return self.values.numpy(), no_bits, self.row_points.numpy(), self._slots, self.initial_value

    def _resize(self, capacity: int) -> None:
        for name, fill in (("values", self.initial_value), ("row_points", -1)):
            old = getattr(self, name)
            new = th.full((capacity, *old.shape[1:]), fill, dtype=old.dtype)
            new[: len(old)] = old[:capacity]
            setattr(self, name, new)
        self._slots = make_slots(capacity)
        rehash(self.row_points.numpy(), self.n_visited, self._slots)

    def _refill(self, points: th.Tensor, values: th.Tensor) -> None:
        """Have these rows and no others."""
        self._forget_lent()
        # Nothing of the rows there were may show through those to be made.
        self.values, self.row_points = self.values[:0], self.row_points[:0]
        self.counts[0] = 0
        self._resize(max(self.SMALLEST, len(points)))
        self.values[: len(points)] = values
        self.row_points[: len(points)] = points
        self.counts[0] = len(points)
        rehash(self.row_points.numpy(), len(points), self._slots)

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        for name in ("values", "row_points"):
            destination[prefix + name] = destination[prefix + name][: self.n_visited].clone()

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        points = checked_points(state_dict, prefix + "row_points", self.n_points)
        self._refill(points, checked_tensor(state_dict, prefix + "values", (len(points), self.n_actions)))
        whole = {prefix + name: getattr(self, name).clone() for name in ("values", "row_points")}
        super()._load_from_state_dict({**state_dict, **whole}, prefix, *args)


def make_slots(capacity: int) -> np.ndarray:
    """
    :param capacity: how many points a hash is to hold
    :return: an empty hash, at most half full then, see :mod:`sb3_knntd.kernels.memory`
    """
    return np.full((1 << (2 * capacity - 1).bit_length(), 2), -1, np.int64)
