"""Rules that forbid actions in regions of the observation space."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.state_checks import checked_tensor


class Rules(nn.Module):
    """
    Where actions are forbidden. A rule forbids some columns of the table in a box of the observation space, edges
    included.

    :param obs_dim: number of observation dimensions
    :param n_columns: number of columns of the table
    """

    low: th.Tensor
    high: th.Tensor
    columns: th.Tensor

    def __init__(self, obs_dim: int, n_columns: int) -> None:
        super().__init__()
        #: incremented whenever the rules change
        self.version = 0
        # Plain numbers: while torch traces, the sizes of tensors are tensors.
        self._obs_dim = obs_dim
        self._n_rules = 0
        self.register_buffer("low", th.empty((0, obs_dim), dtype=th.float64))
        self.register_buffer("high", th.empty((0, obs_dim), dtype=th.float64))
        self.register_buffer("columns", th.empty((0, n_columns), dtype=th.bool))

    def __len__(self) -> int:
        return self._n_rules

    def extra_repr(self) -> str:
        return "\n".join(
            f"columns {columns.nonzero()[:, 0].tolist()} are forbidden from {low.tolist()} to {high.tolist()}"
            for low, high, columns in zip(self.low, self.high, self.columns, strict=True)
        )

    def add(self, low: np.ndarray, high: np.ndarray, columns: np.ndarray, factors: np.ndarray) -> None:
        """
        :param low: lower corner of the region, shape (obs_dim,), observation units; may be infinite
        :param high: upper corner of the region, shape (obs_dim,), observation units; may be infinite
        :param columns: whether each column is forbidden there, shape (n_columns,), bool
        :param factors: the index of the first column of each action factor, and the number of columns
        :raises ValueError: if no action were left somewhere
        """
        lows, highs, forbidden = (
            np.concatenate((old.cpu().numpy(), new[None]))
            for old, new in ((self.low, low), (self.high, high), (self.columns, columns))
        )
        everywhere = np.full_like(low, -np.inf), np.full_like(high, np.inf)
        for first, end in pairwise(factors):
            corner = _without_actions(lows, highs, forbidden[:, first:end], *everywhere)
            if corner is not None:
                raise ValueError(
                    "action: no action would be left in the region from "
                    f"{corner[0].tolist()} to {corner[1].tolist()}, where other rules forbid the remaining ones"
                )
        self._set(*map(th.from_numpy, (lows, highs, forbidden)))

    def clear(self) -> None:
        """Remove all rules."""
        self._set(self.low[:0], self.high[:0], self.columns[:0])

    def _set(self, low: th.Tensor, high: th.Tensor, columns: th.Tensor) -> None:
        device = self.low.device
        self.low, self.high, self.columns = low.to(device), high.to(device), columns.to(device)
        self._n_rules = len(low)
        self.version += 1

    def forbidden(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: the columns that are forbidden there, shape (batch, n_columns), bool
        """
        if not len(self):
            return th.zeros((len(observations), self.columns.shape[1]), dtype=th.bool, device=self.low.device)
        seen = observations.reshape(-1, 1, self._obs_dim).to(self.low)
        inside = ((self.low <= seen) & (seen <= self.high)).all(dim=2)
        return (inside[..., None] & self.columns).any(dim=1)

    def mask(self, rows: th.Tensor, probabilities: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        :param rows: table rows of the neighbours, shape (batch, k, n_columns)
        :param probabilities: of the neighbours, shape (batch, k)
        :param observations: shape (batch, *obs_shape), any number type, observation units
        :return: the rows with -inf at forbidden columns
        """
        return masked(rows, probabilities, self.forbidden(observations)) if len(self) else rows

    def kernel_arguments(self) -> dict[str, Any]:
        """
        :return: the rules as the fields of :class:`~sb3_knntd.kernels.selection.SelectionArguments`
        """
        return {
            "n_rules": len(self),
            "rule_low": self.low.cpu().numpy(),
            "rule_high": self.high.cpu().numpy(),
            "rule_columns": self.columns.cpu().numpy(),
        }

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        own = {prefix + name: buffer for name, buffer in self.state_dict().items()}
        # Files of versions without rules do not have them, and the number of rules can differ.
        if own.keys() <= state_dict.keys():
            obs_dim, n_columns = self.low.shape[1], self.columns.shape[1]
            low = checked_tensor(state_dict, prefix + "low", (None, obs_dim), th.float64, finite=False)
            high = checked_tensor(state_dict, prefix + "high", (len(low), obs_dim), th.float64, finite=False)
            columns = checked_tensor(state_dict, prefix + "columns", (len(low), n_columns), th.bool)
            self._set(low.clone(), high.clone(), columns.clone())
            own = {prefix + name: buffer for name, buffer in self.state_dict().items()}
        super()._load_from_state_dict({**state_dict, **own}, prefix, *args)


def masked(rows: th.Tensor, probabilities: th.Tensor, forbidden: th.Tensor) -> th.Tensor:
    """
    :param rows: table rows of the neighbours, shape (batch, k, n_columns)
    :param probabilities: of the neighbours, shape (batch, k)
    :param forbidden: forbidden columns, shape (batch, n_columns), bool
    :return: the rows with -inf at forbidden columns
    """
    # A neighbour without weight is left as it is, since 0 * -inf is NaN.
    return rows.masked_fill(forbidden[:, None, :] & (probabilities > 0.0)[..., None], -th.inf)


def _without_actions(
    lows: np.ndarray, highs: np.ndarray, forbidden: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """
    Search a region in which the rules together forbid all columns.

    :param lows: lower corners of the rules, shape (n_rules, obs_dim)
    :param highs: upper corners of the rules, shape (n_rules, obs_dim)
    :param forbidden: the columns that each rule forbids, among those not forbidden yet, shape (n_rules, n_columns)
    :param low: lower corner of the region to search in
    :param high: upper corner of the region to search in
    :return: the corners of such a region; ``None`` if there is none
    """
    if forbidden.shape[1] == 0:
        return low, high
    # Some rule must forbid the first column.
    for rule in np.flatnonzero(forbidden[:, 0]):
        inner = np.maximum(low, lows[rule]), np.minimum(high, highs[rule])
        if np.all(inner[0] <= inner[1]):
            found = _without_actions(lows, highs, forbidden[:, ~forbidden[rule]], *inner)
            if found is not None:
                return found
    return None
