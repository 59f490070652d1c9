"""Models of an environment, learned from transitions."""

from sb3_knntd.model.buffer import TransitionBuffer
from sb3_knntd.model.local import LocalModel, Prediction

__all__ = ["LocalModel", "Prediction", "TransitionBuffer"]
