"""The δs filter written for reading: Algorithm 5 of the paper in plain NumPy, one transition at a time.

As `reference.py`: nothing here is shared with the package. Equation numbers are those of Martin H., de Lope and
Maravall (Neurocomputing 74, 2011).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from reference import Array, Perceiver


class ReferenceFilter:
    """Algorithm 5 with a table that several environments may share.

    :param perceive: the neighbours of a state and their probabilities
    :param own_errors: whether δ(knn, a) in line 4 is taken as the list of the neighbours' values, so that each has an
        error of its own; otherwise it is their weighted mean, as Q(knn, a) is in eq. 8
    """

    def __init__(self, perceive: Perceiver, n_actions: int, obs_dim: int, own_errors: bool = False) -> None:
        self.perceive = perceive
        self.own_errors = own_errors
        self.delta = np.zeros((perceive.n_points, n_actions, obs_dim))

    def __call__(self, s: ArrayLike, a: int, next_s: ArrayLike, alpha: float) -> Array:
        """Learn from one transition, and return the filtered next state."""
        s, next_s = np.asarray(s, dtype=np.float64), np.asarray(next_s, dtype=np.float64)
        knn, p = self.perceive(s)
        expected = sum(p[i] * self.delta[knn[i], a] for i in range(len(knn)))
        for i in range(len(knn)):
            error = (next_s - s) - (self.delta[knn[i], a] if self.own_errors else expected)
            self.delta[knn[i], a] = self.delta[knn[i], a] + alpha * p[i] * error
        return np.asarray(s + sum(p[i] * self.delta[knn[i], a] for i in range(len(knn))))
