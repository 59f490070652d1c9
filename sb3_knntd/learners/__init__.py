"""Learners: the torch reference and the compiled implementation."""

from __future__ import annotations

from sb3_knntd.kernels.state import UpdateConfig
from sb3_knntd.learners.base import Learner, Rates, Transitions
from sb3_knntd.learners.compiled import CompiledLearner, GreedyReader
from sb3_knntd.learners.reference import TorchLearner

__all__ = ["CompiledLearner", "GreedyReader", "Learner", "Rates", "TorchLearner", "Transitions", "UpdateConfig"]
