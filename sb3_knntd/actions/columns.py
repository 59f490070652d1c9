"""The actions that the columns of the table stand for."""

from __future__ import annotations

import math
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_knntd.common.checks import check_integer, check_numbers, check_size, check_word, in_bytes, shown

#: ``action_table=None``: maximum number of columns of a joint table; with more combinations the table is factored.
MOST_JOINT_COLUMNS = 128
#: Maximum number of columns: a row takes 8 MiB for each visited point.
MOST_COLUMNS = 2**20


class ActionColumns(NamedTuple):
    """
    The actions that the columns of the table stand for.

    :param points: the action of each column, shape (n_columns, action_dim), action units; in a factored table zero in
        all but one dimension
    :param factors: index of the first column of each action factor, and the number of columns, shape (n_factors + 1,),
        int64
    :param lists: the action points of each dimension, ascending
    """

    points: np.ndarray
    factors: np.ndarray
    lists: list[np.ndarray]

    def nearest(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: shape (n, action_dim), action units
        :return: the columns of the nearest action points, one for each action factor, shape (n, n_factors), int64
        :raises ValueError: if the shape is wrong, or an action is not finite
        """
        vectors, action_dim = np.asarray(actions, dtype=np.float64), self.points.shape[1]
        if vectors.ndim != 2 or vectors.shape[1] != action_dim or not np.isfinite(vectors).all():
            raise ValueError(f"actions must be finite and of shape (n, {action_dim}); got shape {vectors.shape}")
        found = []
        for factor, (first, end) in enumerate(pairwise(self.factors.tolist())):
            # A factored table has a factor for each dimension of the action.
            dims = slice(None) if len(self.factors) == 2 else slice(factor, factor + 1)
            distances = (vectors[:, None, dims] - self.points[None, first:end, dims]) ** 2
            found.append(first + distances.sum(axis=2).argmin(axis=1))
        return np.stack(found, axis=1).astype(np.int64)

    def scale(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: shape (..., action_dim), action units
        :return: the same with the range of the action points as [-1, 1]; 0 in dimensions of one action point
        """
        low, width = self._range()
        return np.where(width > 0.0, 2.0 * (actions - low) / np.where(width > 0.0, width, 1.0) - 1.0, 0.0)

    def unscale(self, scaled: np.ndarray) -> np.ndarray:
        """
        :param scaled: shape (..., action_dim), the range of the action points is [-1, 1]
        :return: the same in action units
        """
        low, width = self._range()
        actions: np.ndarray = low + 0.5 * (scaled + 1.0) * width
        return actions

    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        low = np.array([points[0] for points in self.lists])
        return low, np.array([points[-1] for points in self.lists]) - low


def discrete_columns(n_actions: int) -> ActionColumns:
    """
    :param n_actions: number of actions
    :return: one column for each action
    """
    return ActionColumns(np.empty((n_actions, 0)), np.array([0, n_actions]), [])


def make_action_columns(action_space: spaces.Box, action_points: Any, action_table: str | None) -> ActionColumns:
    """
    :param action_space: Box with finite bounds
    :param action_points: an int or one int per dimension for evenly spaced points over the space, or a list of one
        array per dimension in action units (for one dimension, also the array itself)
    :param action_table: ``"joint"`` (a column for every combination), ``"factored"`` (separate columns for each
        dimension), or ``None``: joint up to 128 combinations
    :return: the columns
    :raises ValueError: if the bounds are infinite, the points do not fit the space, or a joint table would have more
        than 2²⁰ columns
    """
    low, high = action_space.low.reshape(-1).astype(np.float64), action_space.high.reshape(-1).astype(np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(
            f"the action space must have finite bounds; got {action_space}. Bound it, e.g. by "
            "gymnasium.wrappers.RescaleAction or another Box"
        )
    lists = [
        _points_of_dimension(dimension, given, low[dimension], high[dimension], action_space.dtype)
        for dimension, given in enumerate(_by_dimension(action_points, len(low)))
    ]
    n_joint = math.prod(len(points) for points in lists)
    if action_table is None:
        action_table = "joint" if n_joint <= MOST_JOINT_COLUMNS else "factored"
    check_word("action_table", action_table, ["joint", "factored"])
    if action_table == "joint":
        if n_joint > MOST_COLUMNS:
            raise ValueError(
                f"action_table='joint' would need {n_joint:,} columns for {len(lists)} action dimensions, "
                f"{in_bytes(8 * n_joint)} for each point visited: use action_table='factored', or fewer "
                "action_points"
            )
        return ActionColumns(np.array(list(product(*lists))), np.array([0, n_joint]), lists)
    factors = np.concatenate(([0], np.cumsum([len(points) for points in lists])))
    columns = np.zeros((factors[-1], len(lists)))
    for dimension, points in enumerate(lists):
        columns[factors[dimension] : factors[dimension + 1], dimension] = points
    return ActionColumns(columns, factors, lists)


def _by_dimension(action_points: Any, action_dim: int) -> list[Any]:
    if isinstance(action_points, str):
        raise ValueError(f"action_points must be an int, one int a dimension, or arrays; got {shown(action_points)}")
    if _is_single(action_points):
        return [check_integer("action_points", action_points, 2)] * action_dim
    given = list(action_points)
    # For one dimension, a plain list of points is accepted as well.
    if action_dim == 1 and given and all(map(_is_single, given)) and len(given) != 1:
        return [given]
    if len(given) != action_dim:
        raise ValueError(
            f"action_points: an int or an array for each of the {action_dim} action dimensions is needed; got "
            f"{len(given)}: {shown(action_points)}"
        )
    return given


def _points_of_dimension(dimension: int, given: Any, low: float, high: float, dtype: Any) -> np.ndarray:
    name = f"action_points of dimension {dimension}"
    if _is_single(given):
        n_points = check_integer(name, given, 2)
        # Each point needs a column of the table, and its action.
        check_size(f"{name}: {n_points} points", 3 * 8 * n_points, "give fewer")
        return np.linspace(low, high, n_points)
    points = check_numbers(name, given)
    if points.ndim != 1 or len(points) == 0:
        raise ValueError(f"{name} must be a list of at least one number; got {shown(given)}")
    # The bounds of the space are rounded to its dtype, e.g. 0.7 to float32: points that round to a bound are equal to
    # it. Points that overflow the dtype equal no bound.
    with np.errstate(over="ignore", invalid="ignore"):
        for bound in (low, high):
            points = np.where(points.astype(dtype) == bound, bound, points)
    if not np.isfinite(points).all() or points.min() < low or points.max() > high:
        raise ValueError(f"{name} must lie within the action space, [{low:g}, {high:g}]; got {shown(points.tolist())}")
    if np.any(np.diff(points) <= 0):
        raise ValueError(f"{name} must rise; got {shown(points.tolist())}")
    return points


def _is_single(value: Any) -> bool:
    """Whether the value is a scalar, not an array or a list."""
    return not isinstance(value, (list, tuple)) and np.ndim(value) == 0
