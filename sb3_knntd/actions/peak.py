"""Selection of a continuous action between action points."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch as th

from sb3_knntd.actions.columns import ActionColumns
from sb3_knntd.actions.exploration import EpsilonGreedy, greedy
from sb3_knntd.actions.rules import Rules
from sb3_knntd.actions.selection import MeanValueSelector
from sb3_knntd.kernels.selection import Target

#: Parabolas that are flatter than this, relative to their values, have no peak.
LEAST_CURVATURE = 1e-12


def columns_beside(columns: ActionColumns) -> np.ndarray:
    """
    :param columns: the action points, one column for every combination
    :return: the columns below and above each column in each dimension, itself at the ends, shape
        (action_dim, 2, n_columns), int64
    """
    shape = [len(points) for points in columns.lists]
    places = np.indices(shape).reshape(len(shape), -1)
    beside = np.empty((len(shape), 2, len(columns.points)), np.int64)
    for dimension, side in np.ndindex(len(shape), 2):
        shifted = places.copy()
        shifted[dimension] += 2 * side - 1
        beside[dimension, side] = np.ravel_multi_index(tuple(shifted), shape, mode="clip")
    return beside


class PeakSelector(MeanValueSelector):
    """
    The neighbours' values are averaged, and the action is the peak of a parabola through the value of the best action
    point and those next to it, in each dimension. It moves by at most half of the way to the next action point. At the
    first and the last action point of a dimension, the action is that point.

    :param columns: the action points, one column for every combination
    :param random_ties: whether ties between best columns are broken at random while training
    :param rules: where columns are forbidden; nowhere by default
    """

    interpolates: ClassVar[bool] = True

    def __init__(self, columns: ActionColumns, random_ties: bool, rules: Rules | None = None) -> None:
        super().__init__(columns, Target.Q_LEARNING, EpsilonGreedy(), random_ties, rules)
        if self.n_factors != 1:
            raise ValueError("action_table must be 'joint': a column for every combination of action points")
        #: the columns below and above each column in each dimension, itself at the ends, (action_dim, 2, n_columns)
        self.sides = th.from_numpy(columns_beside(columns))
        self._points = th.from_numpy(columns.points)

    def peak(self, values: th.Tensor, best: th.Tensor) -> th.Tensor:
        """
        :param values: mean values of the action points, shape (batch, n_columns)
        :param best: the best columns, shape (batch,), int64
        :return: actions, shape (batch, action_dim), action units
        """
        points, sides = self._points.to(values.device), self.sides.to(values.device)
        actions = points[best].clone()
        middle = values.gather(1, best[:, None])[:, 0]
        for dimension in range(actions.shape[1]):
            low, high = sides[dimension, 0][best], sides[dimension, 1][best]
            x_low, x_mid, x_high = (points[column, dimension] for column in (low, best, high))
            left, right = x_mid - x_low, x_high - x_mid
            # Divided differences of the parabola through the three values.
            slope_left = (middle - values.gather(1, low[:, None])[:, 0]).double() / left
            slope_right = (values.gather(1, high[:, None])[:, 0] - middle).double() / right
            curvature = (slope_right - slope_left) / (left + right)
            slope = (slope_left * right + slope_right * left) / (left + right)
            offset = (-0.5 * slope / curvature).clamp(min=-0.5 * left, max=0.5 * right)
            has_peak = offset.isfinite() & (
                (left > 0)
                & (right > 0)
                & (curvature * (left + right) ** 2 < -LEAST_CURVATURE * middle.abs().clamp(min=1.0))
            )
            actions[:, dimension] += th.where(has_peak, offset, 0.0)
        return actions

    def greedy_actions(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        # Added one after the other: columns that are equal in all rows stay equal, whatever the number of columns.
        values = (probabilities[..., None] * rows).cumsum(dim=1)[:, -1]
        return self.peak(values, greedy(values))

    def actions_of(self, action_indices: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        return self._points.to(probabilities.device)[action_indices[:, 0, 0]]

    def columns_of(self, actions: np.ndarray) -> np.ndarray:
        return self.columns.nearest(actions)
