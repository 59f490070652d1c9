"""The Q-table: one row a perception point, one column an action."""

from __future__ import annotations

import torch as th
from torch import nn


class QTable(nn.Module):
    """
    A dense table.

    :param n_points: number of rows
    :param n_actions: number of columns
    :param initial_value: what every entry is at the start
    :param dtype: floating type of the entries
    """

    values: th.Tensor
    visited: th.Tensor

    def __init__(self, n_points: int, n_actions: int, initial_value: float, dtype: th.dtype) -> None:
        super().__init__()
        self.register_buffer("values", th.full((n_points, n_actions), initial_value, dtype=dtype))
        #: which rows have been learned at, shape (n_points,)
        self.register_buffer("visited", th.zeros(n_points, dtype=th.bool))

    def rows(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, shape (batch, k), int64
        :return: their values, shape (batch, k, n_actions)
        """
        return self.values[indices]
