"""What was seen while learning: the range of the observations, their changes and the rewards."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

from sb3_knntd.common.state_checks import checked_tensor
from sb3_knntd.kernels.experience import (
    CHANGE,
    HIGH,
    LEAST_REWARD,
    LOW,
    MOST_REWARD,
    N_BEYOND,
    N_CHANGES,
    N_STEPS,
    ROUNDING,
    ExperienceArrays,
)
from sb3_knntd.perception.bounds import Bounds


class Experience(nn.Module):
    """
    Statistics of all steps that were learned from. They are part of the state dict; a state without them, of a version
    that did not save them, starts them anew.

    :param obs_dim: number of observation dimensions
    """

    seen: th.Tensor
    totals: th.Tensor

    def __init__(self, obs_dim: int) -> None:
        super().__init__()
        seen, totals = th.zeros((4, obs_dim), dtype=th.float64), th.zeros(4, dtype=th.float64)
        seen[LOW], seen[HIGH] = th.inf, -th.inf
        totals[LEAST_REWARD], totals[MOST_REWARD] = th.inf, -th.inf
        self.register_buffer("seen", seen)
        self.register_buffer("totals", totals)

    @property
    def n_steps(self) -> int:
        """Number of steps that were learned from, over all environments."""
        return int(self.totals[N_STEPS])

    @property
    def low(self) -> th.Tensor:
        """The lowest observation, shape (obs_dim,), observation units; infinity before the first."""
        return self.seen[LOW]

    @property
    def high(self) -> th.Tensor:
        """The highest observation, shape (obs_dim,), observation units; minus infinity before the first."""
        return self.seen[HIGH]

    @property
    def rewards(self) -> tuple[float, float]:
        """The lowest and the highest reward; (infinity, minus infinity) before the first."""
        return float(self.totals[LEAST_REWARD]), float(self.totals[MOST_REWARD])

    @property
    def share_beyond(self) -> th.Tensor:
        """Share of the observations that were beyond the bounds in each dimension, shape (obs_dim,)."""
        return self.seen[N_BEYOND] / self.totals[N_STEPS].clamp(min=1.0)

    @property
    def mean_change(self) -> th.Tensor:
        """Mean absolute change from one step to the next, shape (obs_dim,), observation units."""
        return self.seen[CHANGE] / self.totals[N_CHANGES].clamp(min=1.0)

    def record(self, before: th.Tensor, after: th.Tensor, rewards: th.Tensor, ended: th.Tensor, bounds: Bounds) -> None:
        """
        Add steps, as the kernel does.

        :param before: the observations before the steps, shape (n, obs_dim), observation units; infinite if unknown
        :param after: those after the steps, shape (n, obs_dim), observation units
        :param rewards: shape (n,)
        :param ended: whether ``after`` does not follow ``before``, shape (n,), bool
        :param bounds: the range that is mapped to [-1, 1]
        """
        if not len(after):
            return
        before, after, rewards = before.to(self.seen), after.to(self.seen), rewards.to(self.seen)
        shares = (after - bounds.low) / (bounds.high - bounds.low)
        go_on = ~ended.to(self.seen.device) & ~before[:, 0].isinf()
        self.seen[LOW] = th.minimum(self.low, after.amin(dim=0))
        self.seen[HIGH] = th.maximum(self.high, after.amax(dim=0))
        self.seen[N_BEYOND] += ((shares < -ROUNDING) | (shares > 1.0 + ROUNDING)).sum(dim=0)
        self.seen[CHANGE] += th.where(go_on[:, None], (after - before).abs(), 0.0).sum(dim=0)
        self.totals[N_STEPS] += len(after)
        self.totals[N_CHANGES] += go_on.sum()
        self.totals[LEAST_REWARD] = th.minimum(self.totals[LEAST_REWARD], rewards.amin())
        self.totals[MOST_REWARD] = th.maximum(self.totals[MOST_REWARD], rewards.amax())

    def arrays(self) -> ExperienceArrays:
        """
        :return: the arrays for the kernels, which share memory with this object
        """
        return ExperienceArrays(self.seen.numpy(), self.totals.numpy())

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        given = {}
        for name, fresh in Experience(self.seen.shape[1]).state_dict().items():
            if prefix + name in state_dict:
                checked_tensor(state_dict, prefix + name, tuple(fresh.shape), finite=False)
            given[prefix + name] = state_dict.get(prefix + name, fresh)
        super()._load_from_state_dict({**state_dict, **given}, prefix, *args)
