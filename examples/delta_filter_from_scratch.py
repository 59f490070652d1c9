"""
The δs filter from scratch: Algorithm 5 in plain NumPy, which removes noise from the observations of Mountain-Car.

    python examples/delta_filter_from_scratch.py [--steps 20000] [--seed 0]

Read knn_td_from_scratch.py first, which defines perception. Equation and algorithm numbers are those of Martin H.,
de Lope and Maravall, "Robust high performance reinforcement learning through weighted k-nearest neighbors"
(Neurocomputing 74, 2011). The code is not optimised, and shares nothing with the package. The package's filter adapts
its gain to the noise, and removes more of it. With ``gain=None`` it is this filter; the tests compare both.
"""

from __future__ import annotations

import argparse

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from knn_td_from_scratch import Array, NearestPoints, Perceiver
from numpy.typing import ArrayLike


class PaperFilter:
    """
    Algorithm 5: learn the change of the state at each point for each action, and return the predicted state instead of
    the observed one.

    :param perceive: maps a state to its neighbours
    :param n_actions: number of actions
    :param obs_dim: dimension of the state
    :param own_errors: how to read δ(knn, a) in line 4: as the list of the neighbours' values, so that each neighbour
        has its own error (True), or as their mean, so that all have the same error (False)
    """

    def __init__(self, perceive: Perceiver, n_actions: int, obs_dim: int, own_errors: bool = False) -> None:
        self.perceive = perceive
        self.own_errors = own_errors
        self.delta: Array = np.zeros((perceive.n_points, n_actions, obs_dim))

    def __call__(self, state: ArrayLike, action: int, observed: ArrayLike, alpha: float) -> Array:
        """
        Learn from one transition.

        :param state: the state before the step, as returned by the previous call
        :param action: the action taken there
        :param observed: the noisy observation after the step
        :param alpha: learning rate
        :return: the filtered state after the step
        """
        state, observed = np.asarray(state, dtype=np.float64), np.asarray(observed, dtype=np.float64)
        indices, p = self.perceive(state)
        # The expected change is the neighbours' mean, as the value of an action is in eq. 8.
        expected = p @ self.delta[indices, action]
        errors = (observed - state) - (self.delta[indices, action] if self.own_errors else expected)
        self.delta[indices, action] += alpha * p[:, None] * errors
        return np.asarray(state + p @ self.delta[indices, action])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    env = gym.make("MountainCar-v0")
    space = env.observation_space
    assert isinstance(space, spaces.Box)
    rng = np.random.default_rng(arguments.seed)
    noise = 0.03 * (space.high - space.low)
    denoise = PaperFilter(NearestPoints((20, 20), (space.low, space.high), 4), n_actions=3, obs_dim=2)

    errors = []
    env.reset(seed=arguments.seed)
    ended = True
    for _ in range(arguments.steps):
        if ended:
            truth, _ = env.reset()
            # The first estimate of an episode is its first observation.
            estimate = truth + rng.normal(0.0, noise)
        # A controller that knows the true state and pushes in the direction of the velocity.
        action = 2 if truth[1] > 0 else 0
        truth, _, terminated, truncated, _ = env.step(action)
        observed = truth + rng.normal(0.0, noise)
        estimate = denoise(estimate, action, observed, alpha=0.5)
        errors.append((observed - truth, estimate - truth))
        ended = terminated or truncated
    half = np.array(errors[len(errors) // 2 :])
    sensed, filtered = np.sqrt((half**2).mean(axis=0))
    for dimension, name in enumerate(("position", "velocity")):
        print(
            f"{name}: root mean square error {sensed[dimension]:.4f} of the sensor, "
            f"{filtered[dimension]:.4f} of the filter"
        )


if __name__ == "__main__":
    main()
