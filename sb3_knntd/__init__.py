"""kNN-TD(λ) for Stable-Baselines3: a weighted k-nearest-neighbour table in place of a network."""

from __future__ import annotations

from importlib.metadata import version

from sb3_knntd.dyna import KNNDyna
from sb3_knntd.exa import ExA
from sb3_knntd.filters import DeltaFilter, VecDeltaFilter
from sb3_knntd.knntd import KNNTD
from sb3_knntd.perception import Perception
from sb3_knntd.policies import ExAPolicy, KNNPolicy, load_policy

__all__ = [
    "KNNTD",
    "DeltaFilter",
    "ExA",
    "ExAPolicy",
    "KNNDyna",
    "KNNPolicy",
    "Perception",
    "VecDeltaFilter",
    "load_policy",
]
__version__ = version("sb3-knntd")
