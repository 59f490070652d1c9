"""
kNN-TD(λ) from scratch: the whole algorithm in plain NumPy, and a training loop that solves Mountain-Car with it.

    python examples/knn_td_from_scratch.py [--episodes 150] [--seed 0]

Read it from top to bottom: perception, values, learning, training. Equation, line and algorithm numbers are those of
Martin H., de Lope and Maravall, "Robust high performance reinforcement learning through weighted k-nearest neighbors"
(Neurocomputing 74, 2011). The code uses dense arrays, is not optimised, and shares nothing with the package. The tests
compare the package with this file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Weights = str | Callable[[Array], Array]


# ------------------------------------------------------------------------------------------------- 1. perception
#
# An observation is represented by its k nearest points. Each has a probability p, which is larger for nearer points.


class Neighbours(NamedTuple):
    """
    The perception of one observation.

    :param indices: the k nearest points, nearest first, shape (k,)
    :param probabilities: their weights, shape (k,), with sum 1
    """

    indices: NDArray[np.int64]
    probabilities: Array


class Perceiver(Protocol):
    """Maps an observation to its neighbours among ``n_points`` points."""

    n_points: int

    def __call__(self, observation: ArrayLike) -> Neighbours: ...


def scale(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Eq. 4: map the range from low to high to [-1, 1]. Values outside the range are not clipped."""
    at, start, end = (np.asarray(v, dtype=np.float64) for v in (x, low, high))
    return np.asarray(2.0 * (at - start) / (end - start) - 1.0)


def lattice(sizes: Sequence[int]) -> Array:
    """All points of a regular grid over [-1, 1]^d, shape (n_points, d), the last dimension varying fastest."""
    axes = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in sizes), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def squared_distances(x: Array, points: Array) -> Array:
    """Squared Euclidean distances from one scaled observation to all scaled points, shape (n_points,)."""
    total = np.zeros(len(points))
    # The order of summation is part of the definition: it determines which distances are exactly equal.
    for j in range(points.shape[1]):
        total += (x[j] - points[:, j]) ** 2
    return total


def weigh(squared: Array, weights: Weights, bandwidth: float) -> Array:
    """Eq. 5 and alternatives: the weights of the neighbours before normalisation."""
    if callable(weights):
        return np.asarray(weights(squared), dtype=np.float64)
    if weights == "inverse_quadratic":
        return np.asarray(1.0 / (1.0 + squared / bandwidth**2))
    if weights == "gaussian":
        # Subtracting the minimum does not change the probabilities, and avoids 0 / 0 if all exponentials underflow.
        return np.asarray(np.exp(-(squared - squared.min()) / (2.0 * bandwidth**2)))
    raise ValueError(weights)


class NearestPoints:
    """
    Perceive a continuous observation by its k nearest points (eqs. 4 to 6).

    :param points: number of points per dimension (a lattice), or the points in observation units, shape
        (n_points, obs_dim)
    :param bounds: smallest and largest value of each dimension
    :param n_neighbors: k
    :param weights: ``"inverse_quadratic"``, ``"gaussian"``, or a function of the squared distances
    :param bandwidth: distance, in scaled units, over which the weights decrease
    """

    def __init__(
        self,
        points: Sequence[int] | NDArray[Any],
        bounds: tuple[ArrayLike, ArrayLike],
        n_neighbors: int,
        weights: Weights = "inverse_quadratic",
        bandwidth: float = 1.0,
    ) -> None:
        self.bounds = bounds
        self.points = scale(points, *bounds) if isinstance(points, np.ndarray) else lattice(points)
        self.n_points = len(self.points)
        self.n_neighbors = n_neighbors
        self.weights = weights
        self.bandwidth = bandwidth

    def __call__(self, observation: ArrayLike) -> Neighbours:
        squared = squared_distances(scale(observation, *self.bounds), self.points)
        # A stable sort breaks ties in favour of the lower index.
        nearest = np.argsort(squared, kind="stable")[: self.n_neighbors]
        w = weigh(squared[nearest], self.weights, self.bandwidth)
        return Neighbours(nearest, w / w.sum())


class ExactStates:
    """Perceive a discrete observation exactly: each state is a point, which is its only neighbour."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = tuple(int(n) for n in sizes)
        self.n_points = int(np.prod(self.sizes))

    def __call__(self, observation: ArrayLike) -> Neighbours:
        coordinates = np.asarray(observation, dtype=np.int64).reshape(len(self.sizes))
        index = np.ravel_multi_index(tuple(coordinates), self.sizes)
        return Neighbours(np.array([index]), np.array([1.0]))


def make_perceiver(space: spaces.Space[Any], **settings: Any) -> Perceiver:
    """The perceiver for an observation space; the settings are those of `NearestPoints`."""
    if isinstance(space, spaces.Discrete):
        return ExactStates([int(space.n)])
    if isinstance(space, spaces.MultiDiscrete):
        return ExactStates([int(n) for n in space.nvec])
    return NearestPoints(**settings)


# --------------------------------------------------------------------------------------------------- 2. the agent
#
# Every point i holds a value Q(i, a) for each action a. The value of an action at an observation is the mean over the
# neighbours, weighted by p. A TD error updates all entries in proportion to their traces.


@dataclass
class Transition:
    """
    One step of one environment.

    :param next_state: the observation after the step; at the end of an episode its last observation, not the first one
        of the next episode
    :param next_action: the action selected there, used by SARSA; ``None`` for the greedy action
    """

    state: Any
    action: int
    reward: float
    next_state: Any
    terminated: bool = False
    truncated: bool = False
    next_action: int | None = None


@dataclass
class Rates:
    """
    Parameters that may change from step to step.

    :param learning_rate: α
    :param trace_decay: λ
    :param epsilon: probability of a random action, for ``exploration="epsilon_greedy"``
    :param temperature: temperature of the softmax, for ``exploration="softmax"``
    """

    learning_rate: float
    trace_decay: float
    epsilon: float = 0.0
    temperature: float = 1.0


def shared_step(traces: Array, scaled_errors: Array) -> Array:
    """
    The update of a table that several environments share.

    The update of each entry is the mean of the environments' errors, weighted by their traces there, times the largest
    of these traces: the updates of environments in the same place are averaged instead of added. For one environment
    this is eq. 14, α δ e.

    :param traces: e of each environment, shape (n_envs, n_points, n_actions)
    :param scaled_errors: α δ of each environment, shape (n_envs,)
    :return: change of the table, shape (n_points, n_actions)
    """
    total = traces.sum(axis=0)
    largest = traces.max(axis=0)
    share = np.divide(largest, total, out=np.zeros_like(total), where=total > 0)
    summed = (scaled_errors[:, None, None] * traces).sum(axis=0)
    return np.asarray(share * summed)


class KNNTDAgent:
    """
    Algorithm 3, with one table for ``n_envs`` environments, each of which has its own traces.

    :param perceive: maps an observation to its neighbours
    :param gamma: discount factor
    :param target: ``"sarsa"``, ``"q_learning"`` or ``"expected_sarsa"``
    :param traces: ``"replacing"`` or ``"accumulating"``
    :param reset_other_actions: whether replacing traces clear those of the actions that were not taken
    :param step_size: ``"paper"`` for α, or ``"normalized"`` for α / Σp², which removes the share α of the error at the
        state for every k
    :param exploration: ``"epsilon_greedy"`` or ``"softmax"``
    """

    def __init__(
        self,
        perceive: Perceiver,
        n_actions: int,
        n_envs: int = 1,
        *,
        gamma: float = 1.0,
        target: str = "sarsa",
        traces: str = "replacing",
        reset_other_actions: bool = False,
        step_size: str = "paper",
        exploration: str = "epsilon_greedy",
        initial_value: float = 0.0,
    ) -> None:
        self.perceive = perceive
        self.gamma = gamma
        self.target = target
        self.trace_kind = traces
        self.reset_other_actions = reset_other_actions
        self.step_size = step_size
        self.exploration = exploration
        self.q_table: Array = np.full((perceive.n_points, n_actions), initial_value, dtype=np.float64)
        self.traces: Array = np.zeros((n_envs, perceive.n_points, n_actions))

    # Acting

    def q_values(self, state: Any) -> Array:
        """Eq. 8: the value of every action, shape (n_actions,)."""
        indices, p = self.perceive(state)
        # Not a matrix product: the sums of all actions must have the same order, or rounding could make equal values
        # unequal.
        return np.asarray((p[:, None] * self.q_table[indices]).sum(axis=0))

    def greedy_action(self, state: Any) -> int:
        """Eq. 9: the best action, the first in case of ties."""
        return int(np.argmax(self.q_values(state)))

    def action_probabilities(self, state: Any, rates: Rates) -> Array:
        """The probability of every action under the exploration policy, shape (n_actions,)."""
        q = self.q_values(state)
        if self.exploration == "epsilon_greedy":
            probabilities = np.full(len(q), rates.epsilon / len(q))
            probabilities[np.argmax(q)] += 1.0 - rates.epsilon
            return probabilities
        if self.exploration == "softmax":
            preferences = np.exp((q - q.max()) / rates.temperature)
            return np.asarray(preferences / preferences.sum())
        raise ValueError(self.exploration)

    def sample_action(self, state: Any, rates: Rates, rng: np.random.Generator) -> int:
        """A sample from the exploration policy."""
        probabilities = self.action_probabilities(state, rates)
        return int(rng.choice(len(probabilities), p=probabilities))

    # Learning

    def next_value(self, step: Transition, rates: Rates) -> float:
        """The value of the state after the step: 0 after a terminal state; after a truncation the target bootstraps."""
        if step.terminated:
            return 0.0
        q = self.q_values(step.next_state)
        if self.target == "sarsa":
            return float(q[np.argmax(q) if step.next_action is None else step.next_action])
        if self.target == "q_learning":
            return float(q.max())
        if self.target == "expected_sarsa":
            return float(self.action_probabilities(step.next_state, rates) @ q)
        raise ValueError(self.target)

    def td_error(self, step: Transition, rates: Rates) -> float:
        """Eq. 11 or 12: δ."""
        expected = self.q_values(step.state)[step.action]
        return float(step.reward + self.gamma * self.next_value(step, rates) - expected)

    def set_traces(self, env: int, step: Transition) -> None:
        """Eq. 15 or 16: set the traces of the state's neighbours for the action taken."""
        indices, p = self.perceive(step.state)
        if self.trace_kind == "accumulating":
            self.traces[env, indices, step.action] += p
        elif self.trace_kind == "replacing":
            if self.reset_other_actions:
                self.traces[env, indices, :] = 0.0
            self.traces[env, indices, step.action] = p
        else:
            raise ValueError(self.trace_kind)

    def alpha(self, step: Transition, rates: Rates) -> float:
        """The step size."""
        if self.step_size == "paper":
            return rates.learning_rate
        if self.step_size == "normalized":
            return float(rates.learning_rate / np.sum(self.perceive(step.state).probabilities ** 2))
        raise ValueError(self.step_size)

    def learn(self, steps: Sequence[Transition], rates: Rates) -> None:
        """Lines 15 to 20: learn from one step of every environment."""
        # Compute all errors before the update: no environment uses values that another has just updated.
        errors = np.array([self.td_error(step, rates) for step in steps])
        alphas = np.array([self.alpha(step, rates) for step in steps])
        for env, step in enumerate(steps):
            self.set_traces(env, step)
        self.q_table += shared_step(self.traces, alphas * errors)
        # Eq. 17
        self.traces *= self.gamma * rates.trace_decay
        for env, step in enumerate(steps):
            if step.terminated or step.truncated:
                self.traces[env] = 0.0


# ------------------------------------------------------------------------------------------------- 3. training


def train(env: gym.Env[Any, Any], agent: KNNTDAgent, rates: Rates, n_episodes: int, seed: int) -> list[float]:
    """Algorithm 3 in one environment. Returns the return of each episode."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    returns = []
    for _ in range(n_episodes):
        state, _ = env.reset()
        action = agent.sample_action(state, rates, rng)
        total, terminated, truncated = 0.0, False, False
        while not (terminated or truncated):
            next_state, reward, terminated, truncated, _ = env.step(action)
            # SARSA: select the next action before the table changes.
            next_action = agent.sample_action(next_state, rates, rng)
            step = Transition(state, action, float(reward), next_state, terminated, truncated, next_action)
            agent.learn([step], rates)
            state, action = next_state, next_action
            total += float(reward)
        returns.append(total)
    return returns


def evaluate(env: gym.Env[Any, Any], act: Callable[[Any], Any], n_episodes: int) -> float:
    """The mean return of ``act``, a function from observations to actions."""
    total = 0.0
    for _ in range(n_episodes):
        state, _ = env.reset()
        terminated = truncated = False
        while not (terminated or truncated):
            state, reward, terminated, truncated, _ = env.step(act(state))
            total += float(reward)
    return total / n_episodes


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    env = gym.make("MountainCar-v0")
    space, actions = env.observation_space, env.action_space
    assert isinstance(space, spaces.Box)
    assert isinstance(actions, spaces.Discrete)
    # A bandwidth of one lattice spacing, so that distant neighbours have small weights.
    perceive = NearestPoints((22, 22), (space.low, space.high), 10, weights="gaussian", bandwidth=2 / 21)
    # Optimistic: all returns are below -10, so every action is tried. 0 works as well, but takes longer.
    agent = KNNTDAgent(perceive, int(actions.n), step_size="normalized", initial_value=-10.0)
    returns = train(env, agent, Rates(learning_rate=0.4, trace_decay=0.92), arguments.episodes, arguments.seed)
    for start in range(0, len(returns), 25):
        block = returns[start : start + 25]
        print(f"episodes {start + 1} to {start + len(block)}: mean return {np.mean(block):.1f}")
    print(f"greedy policy: mean return {evaluate(env, agent.greedy_action, 100):.1f} over 100 episodes")


if __name__ == "__main__":
    main()
