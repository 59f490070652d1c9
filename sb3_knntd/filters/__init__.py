"""The δs filter (Algorithm 5 of the paper), which estimates the state from noisy observations."""

from __future__ import annotations

from sb3_knntd.filters.gym_filter import DeltaFilter
from sb3_knntd.filters.vec_filter import VecDeltaFilter

__all__ = ["DeltaFilter", "VecDeltaFilter"]
