"""What a policy does, as plain numbers: the description that the formats write."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_knntd.actions.columns import ActionColumns
from sb3_knntd.actions.rules import Rules
from sb3_knntd.actions.selection import ActionSelector
from sb3_knntd.common.checks import check_size, check_word
from sb3_knntd.kernels.perceive import Weighting
from sb3_knntd.kernels.selection import Combination
from sb3_knntd.perception import Lattice, Perceiver, Weights
from sb3_knntd.perception.bounds import count_states
from sb3_knntd.perception.weights import KernelWeights
from sb3_knntd.q_table import QTable

#: ``rows``: which rows of the table are stored.
ROWS = ("auto", "changed", "all")
#: Size of the number of a point beside its row, bytes.
NUMBER_BYTES = 8
#: Observations beyond the range of the points by this fraction of it are among the test vectors.
BEYOND = 0.1


class Exportable(Protocol):
    """What the formats ask of a policy."""

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    perceiver: Perceiver
    table: QTable

    def frozen(self) -> FrozenPolicy: ...

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, Any]: ...

    def q_values(self, observation: np.ndarray) -> th.Tensor: ...

    def state_dict(self) -> Mapping[str, Any]: ...

    def _get_constructor_parameters(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class FrozenPolicy:
    """
    A greedy policy: an observation is scaled by ``low`` and ``high``, its nearest points are weighted by distance, and
    the rows of the table there select an action.

    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :param action_space: Discrete or Box
    :param low: the values mapped to -1, observation units, shape (obs_dim,)
    :param high: the values mapped to 1, observation units, shape (obs_dim,)
    :param lattice: the points, if they form a lattice
    :param places: the points otherwise, scaled units, shape (n_points, obs_dim)
    :param n_neighbors: k
    :param weights: weights of the neighbours by distance
    :param values: rows of the table, shape (n_rows, n_columns), the table's dtype
    :param row_points: the point of each row, ascending, shape (n_rows,), int64; ``None`` if row i is that of point i
    :param visits: for each row, 0 if learning has not updated it, shape (n_rows,), int32
    :param initial_value: value of points without a row
    :param combination: whether the mean of the rows selects one action, or each row one, whose mean is taken
    :param interpolates: whether the action that is selected moves to the peak of a parabola through the values of the
        action points next to it, see :class:`~sb3_knntd.actions.peak.PeakSelector`
    :param columns: the actions that the columns of the table stand for
    :param rules: where actions are forbidden
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    low: np.ndarray
    high: np.ndarray
    lattice: Lattice | None
    places: np.ndarray | None
    n_neighbors: int
    weights: Weights
    values: np.ndarray
    row_points: np.ndarray | None
    visits: np.ndarray
    initial_value: float
    combination: Combination
    interpolates: bool
    columns: ActionColumns
    rules: Rules

    @classmethod
    def of(
        cls,
        perceiver: Perceiver,
        table: QTable,
        selector: ActionSelector,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
    ) -> FrozenPolicy:
        """
        :param perceiver: finds and weights the neighbours
        :param table: the Q-table
        :param selector: selects the actions
        :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
        :param action_space: Discrete or Box
        :return: a copy of what they do now
        :raises ValueError: if there are no points
        """
        bounds, points = perceiver.bounds, perceiver.points
        if not points.n_points:
            raise ValueError("the policy has no points yet, they grow while it learns: call learn before export")
        lattice = points if isinstance(points, Lattice) else None
        with table.lock:
            values, visits = (tensor.cpu().numpy().copy() for tensor in (table.entries(), table.counts()))
            rows = table.points()
            if rows is not None:
                numbers = rows.numpy()
                order = np.argsort(numbers)
                numbers, values, visits = numbers[order], values[order], visits[order]
            return cls(
                observation_space=observation_space,
                action_space=action_space,
                low=bounds.low.cpu().numpy().copy(),
                high=bounds.high.cpu().numpy().copy(),
                lattice=lattice,
                places=None if lattice else points.coordinates(bounds).cpu().numpy(),
                n_neighbors=min(perceiver.search.n_neighbors, points.n_points),
                weights=copy.copy(perceiver.weights),
                values=values,
                row_points=None if rows is None else numbers,
                visits=visits,
                initial_value=table.initial_value,
                combination=Combination(selector.kernel_arguments(greedy=True).combination),
                interpolates=selector.interpolates,
                columns=selector.columns,
                rules=copy.deepcopy(selector.rules).cpu(),
            )

    @property
    def obs_dim(self) -> int:
        """Number of observation dimensions."""
        return len(self.low)

    @property
    def n_points(self) -> int:
        """Number of points."""
        if self.lattice is not None:
            return self.lattice.n_points
        assert self.places is not None
        return len(self.places)

    @property
    def n_columns(self) -> int:
        """Number of columns of the table."""
        return int(self.values.shape[1])

    @property
    def first_action(self) -> int | None:
        """The action of the first column, if actions are Discrete."""
        return int(self.action_space.start) if isinstance(self.action_space, spaces.Discrete) else None

    @property
    def factor_ranges(self) -> list[tuple[int, int]]:
        """The first column of each action factor, and the one after its last."""
        ends = self.columns.factors.tolist()
        return list(pairwise(ends))

    def kernel_weights(self, format: str) -> tuple[Weighting, float]:
        """
        :param format: name of the format, for the message
        :return: the weighting, and its bandwidth in scaled units
        :raises ValueError: if the weights are a function
        """
        if not isinstance(self.weights, KernelWeights):
            raise ValueError(
                f"weights: a function of Python cannot be written as {format!r}; give a named one, "
                f"{', '.join(repr(kind.name.lower()) for kind in Weighting)}, or export to 'torchscript' or "
                "'torch_export', which record functions of torch operations"
            )
        return self.weights.WEIGHTING, self.weights.bandwidth

    def stored(self, rows: str = "auto") -> tuple[np.ndarray, np.ndarray | None]:
        """
        :param rows: ``"all"``; ``"changed"``, those that differ from the initial value; or ``"auto"``, the smaller
        :return: the rows, and the point of each in ascending order; ``None`` if row i is that of point i
        :raises ValueError: if ``rows`` is another word, or all rows would not fit into memory
        """
        check_word("rows", rows, ROWS)
        changed = (self.values != self.initial_value).any(axis=1).nonzero()[0]
        row_bytes = self.n_columns * self.values.itemsize
        if rows == "auto":
            fewer = len(changed) * (row_bytes + NUMBER_BYTES) < self.n_points * row_bytes
            rows = "changed" if fewer else "all"
        if rows == "all":
            return self._every_row(row_bytes), None
        if not len(changed):
            # Not every format knows empty tables.
            return np.full((1, self.n_columns), self.initial_value, self.values.dtype), np.zeros(1, np.int64)
        return self.values[changed], changed if self.row_points is None else self.row_points[changed]

    def _every_row(self, row_bytes: int) -> np.ndarray:
        if self.row_points is None:
            return self.values
        check_size(f"rows='all': {self.n_points} rows", self.n_points * row_bytes, "use rows='changed'")
        every = np.full((self.n_points, self.n_columns), self.initial_value, self.values.dtype)
        every[self.row_points] = self.values
        return every

    def scaled_points(self, numbers: np.ndarray | None = None) -> np.ndarray:
        """
        :param numbers: points, shape (n,), int64; all by default
        :return: their coordinates, scaled units, shape (n, obs_dim)
        """
        numbers = np.arange(self.n_points) if numbers is None else numbers
        if self.lattice is None:
            assert self.places is not None
            return self.places[numbers]
        indices = np.unravel_index(numbers, self.lattice.shape)
        return np.stack([axis[index] for axis, index in zip(self.lattice.axes, indices, strict=True)], axis=1)

    def row_places(self) -> np.ndarray:
        """
        :return: the point of each row, observation units, shape (n_rows, obs_dim)
        """
        places: np.ndarray = self.low + 0.5 * (self.scaled_points(self.row_points) + 1.0) * (self.high - self.low)
        return places

    def sample_observations(self, n: int, seed: int = 0) -> np.ndarray:
        """
        :param n: number of observations
        :param seed: of the random numbers
        :return: random observations of the space, in the range of the points and a tenth of it beyond on either side,
            shape (n, *obs_shape), the dtype of the space
        """
        random, space = np.random.default_rng(seed), self.observation_space
        if isinstance(space, spaces.Box):
            margin = BEYOND * (self.high - self.low)
            drawn = random.uniform(self.low - margin, self.high + margin, (n, self.obs_dim))
            drawn = np.clip(drawn, space.low, space.high)
            observations: np.ndarray = np.rint(drawn) if np.issubdtype(space.dtype, np.integer) else drawn
            return observations.astype(space.dtype)
        first, counts = count_states(space)
        states: np.ndarray = first + (random.uniform(size=(n, self.obs_dim)) * counts).astype(np.int64)
        return states.reshape((n, *(space.shape or ()))).astype(space.dtype)
