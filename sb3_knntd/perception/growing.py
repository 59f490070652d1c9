"""Points that come while an agent learns: visited observations, thinned out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_knntd.common.checks import LEAST, check_integer, check_number, shown
from sb3_knntd.common.state_checks import checked_tensor
from sb3_knntd.kernels.nearest import thin_out
from sb3_knntd.perception.bounds import FARTHEST, Bounds
from sb3_knntd.perception.points import Scattered

#: ``spacing="auto"`` in scaled units: for each dimension but the first, and the least.
SPACING_PER_DIMENSION = 0.06
LEAST_SPACING = 0.04


@dataclass(frozen=True)
class Growth:
    """
    The settings of points that grow. They are checked at once.

    :param spacing: no two points are nearer than this, scaled units, up to 10,000; or ``"auto"``: 0.06 (obs_dim - 1),
        at least 0.04
    :param max_points: largest number of points, >= 2
    :raises ValueError: if a setting is invalid; the message names it
    """

    spacing: float | str = "auto"
    max_points: int = 5000

    def __post_init__(self) -> None:
        check_integer("max_points", self.max_points, 2)
        if not isinstance(self.spacing, str):
            check_number("spacing", self.spacing, LEAST, FARTHEST)
        elif self.spacing != "auto":
            raise ValueError(
                f"spacing must be a finite number in [{LEAST:g}, {FARTHEST:g}], or 'auto'; got {shown(self.spacing)}"
            )

    def make_points(self, obs_dim: int) -> GrowingPoints:
        """
        :param obs_dim: number of observation dimensions
        :return: the points, none yet
        """
        automatic = max(LEAST_SPACING, SPACING_PER_DIMENSION * (obs_dim - 1))
        spacing = automatic if isinstance(self.spacing, str) else float(self.spacing)
        return GrowingPoints(obs_dim, spacing, int(self.max_points))


class GrowingPoints(Scattered):
    """
    Visited observations of which no two are nearer than the spacing. They are kept in observation units. The places and
    the spacing are part of the state dict.

    When ``max_points`` is reached, the points are thinned out: the spacing grows by 2^(1/obs_dim), which halves the
    number of points that fill a volume, until there is room again (Charikar, Chekuri, Feder and Motwani, Incremental
    clustering and dynamic information retrieval, 1997).

    :param obs_dim: number of observation dimensions
    :param spacing: no two points are nearer than this, scaled units
    :param max_points: largest number of points
    """

    spacing: th.Tensor

    def __init__(self, obs_dim: int, spacing: float, max_points: int) -> None:
        super().__init__(np.empty((0, obs_dim)))
        self.max_points = max_points
        #: the spacing at the start, and after the range of a dimension has grown
        self.initial_spacing = spacing
        self.register_buffer("spacing", th.tensor(spacing, dtype=th.float64))

    @property
    def n_reserved(self) -> int:
        # In steps, so that adding a point seldom copies the others.
        return self.n_points + max(64, self.n_points // 4)

    @property
    def is_full(self) -> bool:  # type: ignore[override]
        return self.n_points >= self.max_points

    @property
    def squared_spacing(self) -> float:
        return np.inf if self.is_full else float(self.spacing) ** 2

    def thin(self, bounds: Bounds) -> th.Tensor | None:
        """
        Thin the points out, from the initial spacing on, until no two are nearer than the spacing and there is room
        for more. Of two that are too near, the one that came first stays.

        :param bounds: the range that is mapped to [-1, 1]
        :return: the new index of each point, of a dropped one that of the remaining point nearest to it, shape
            (n_before,), int64; ``None`` if all points stay
        """
        scaled = self.coordinates(bounds).cpu().numpy()
        chosen, owners = np.empty((2, self.n_points), np.int64)
        spacing = self.initial_spacing
        while (n_left := thin_out(scaled, spacing**2, chosen, owners)) >= self.max_points:
            spacing *= 2.0 ** (1.0 / self.obs_dim)
        self.spacing.fill_(spacing)
        if n_left == self.n_points:
            return None
        device = self.places.device
        self._set(self.places[th.from_numpy(chosen[:n_left]).to(device)])
        return th.from_numpy(owners).to(device)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        if prefix + "spacing" in state_dict:
            checked_tensor(state_dict, prefix + "spacing", (), th.float64, LEAST)
        super()._load_from_state_dict(state_dict, prefix, *args)
