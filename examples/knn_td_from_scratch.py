"""
kNN-TD(λ) from scratch: the whole algorithm in plain NumPy, and a training loop that solves Mountain-Car with it.

    python examples/knn_td_from_scratch.py [--episodes 150] [--seed 0]

Read it from top to bottom: perception, values, learning, training. Equation, line and algorithm numbers are those of
Martin H., de Lope and Maravall, "Robust high performance reinforcement learning through weighted k-nearest neighbors"
(Neurocomputing 74, 2011). Arrays are whole and nothing is optimised or shared with the package, whose results the tests
compare with this file's.
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
# An observation is perceived through the k points nearest to it. Each has a probability p, the larger the nearer it is.


class Neighbours(NamedTuple):
    """
    The perception of one observation.

    :param indices: the k nearest points, nearest first, shape (k,)
    :param probabilities: how much each counts, shape (k,), with sum 1
    """

    indices: NDArray[np.int64]
    probabilities: Array


class Perceiver(Protocol):
    """Maps an observation to its neighbours among ``n_points`` points."""

    n_points: int

    def __call__(self, observation: ArrayLike) -> Neighbours: ...


def scale(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Eq. 4: map the range from low to high to [-1, 1]. What lies outside the range is not clipped."""
    at, start, end = (np.asarray(v, dtype=np.float64) for v in (x, low, high))
    return np.asarray(2.0 * (at - start) / (end - start) - 1.0)


def lattice(sizes: Sequence[int]) -> Array:
    """All points of a regular grid over [-1, 1]^d, shape (n_points, d), the last dimension running fastest."""
    axes = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in sizes), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def squared_distances(x: Array, points: Array) -> Array:
    """Squared Euclidean distances from one scaled observation to all scaled points, shape (n_points,)."""
    total = np.zeros(len(points))
    # The order of the sum is part of the definition: it decides which distances come out exactly equal.
    for j in range(points.shape[1]):
        total += (x[j] - points[:, j]) ** 2
    return total


def weigh(squared: Array, weights: Weights, bandwidth: float) -> Array:
    """Eq. 5 and alternatives to it: the weights of the neighbours before they are normalised."""
    if callable(weights):
        return np.asarray(weights(squared), dtype=np.float64)
    if weights == "inverse_quadratic":
        return np.asarray(1.0 / (1.0 + squared / bandwidth**2))
    if weights == "gaussian":
        # Subtracting the minimum leaves the probabilities as they are, and avoids 0 / 0 where every exponential
        # would underflow.
        return np.asarray(np.exp(-(squared - squared.min()) / (2.0 * bandwidth**2)))
    raise ValueError(weights)


class NearestPoints:
    """
    Perceive a continuous observation by its k nearest points (eqs. 4 to 6).

    :param points: number of points in each dimension (a lattice), or the points themselves in observation units,
        shape (n_points, obs_dim)
    :param bounds: lowest and highest value of each dimension
    :param n_neighbors: k
    :param weights: ``"inverse_quadratic"``, ``"gaussian"``, or a function of the squared distances
    :param bandwidth: distance, in scaled units, over which the weights fall
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
        # A stable sort: of equally distant points the lower index counts as nearer.
        nearest = np.argsort(squared, kind="stable")[: self.n_neighbors]
        w = weigh(squared[nearest], self.weights, self.bandwidth)
        return Neighbours(nearest, w / w.sum())


class ExactStates:
    """Perceive a discrete observation exactly: each state is a point, and its own only neighbour."""

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
# neighbours, weighted by p. A TD error is credited to the entries that led to it, in proportion to their traces.


@dataclass
class Transition:
    """
    One step of one environment.

    :param next_state: the observation after the step; at the end of an episode its last one, not the next one's first
    :param next_action: the action chosen there, which SARSA learns from; ``None`` for the greedy one
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
    What may change from one step to the next.

    :param learning_rate: α
    :param trace_decay: λ
    :param epsilon: probability of a random action, with ``exploration="epsilon_greedy"``
    :param temperature: of the softmax, with ``exploration="softmax"``
    """

    learning_rate: float
    trace_decay: float
    epsilon: float = 0.0
    temperature: float = 1.0


def shared_step(traces: Array, scaled_errors: Array) -> Array:
    """
    The change of a table that several environments share.

    Each entry moves by the mean of the environments' errors, weighted by their traces there, times the largest of
    these traces: environments in one place agree on a step rather than adding theirs up. For one environment this is
    eq. 14, α δ e.

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
    :param step_size: ``"paper"`` for α, or ``"normalized"`` for α / Σp², by which the error at the state shrinks by the
        share α whatever k
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
        # Not a matrix product: the sum of every action must be taken in the same order, or equal values would come out
        # unequal and rounding would decide between them.
        return np.asarray((p[:, None] * self.q_table[indices]).sum(axis=0))

    def greedy_action(self, state: Any) -> int:
        """Eq. 9: the best action; of several the first."""
        return int(np.argmax(self.q_values(state)))

    def action_probabilities(self, state: Any, rates: Rates) -> Array:
        """The policy that explores: the probability of every action, shape (n_actions,)."""
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
        """An action of the policy that explores."""
        probabilities = self.action_probabilities(state, rates)
        return int(rng.choice(len(probabilities), p=probabilities))

    # Learning

    def next_value(self, step: Transition, rates: Rates) -> float:
        """The value of the state after the step. After a terminal state nothing follows; a time limit ends nothing."""
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
        """Eq. 15 or 16: the neighbours of the state become eligible, for the action that was taken."""
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
        # All errors before any change: no environment sees what another has just learned.
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
            # SARSA: the action that will be taken is chosen before the table changes.
            next_action = agent.sample_action(next_state, rates, rng)
            step = Transition(state, action, float(reward), next_state, terminated, truncated, next_action)
            agent.learn([step], rates)
            state, action = next_state, next_action
            total += float(reward)
        returns.append(total)
    return returns


def evaluate(env: gym.Env[Any, Any], act: Callable[[Any], Any], n_episodes: int) -> float:
    """The mean return of ``act``, a function from observations to actions, without learning."""
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
    # One spacing of the lattice as bandwidth: near neighbours count, far ones hardly do.
    perceive = NearestPoints((22, 22), (space.low, space.high), 10, weights="gaussian", bandwidth=2 / 21)
    # No return is as high as -10, so every action gets tried. A start at 0 would do as well and take longer.
    agent = KNNTDAgent(perceive, int(actions.n), step_size="normalized", initial_value=-10.0)
    returns = train(env, agent, Rates(learning_rate=0.4, trace_decay=0.92), arguments.episodes, arguments.seed)
    for start in range(0, len(returns), 25):
        block = returns[start : start + 25]
        print(f"episodes {start + 1} to {start + len(block)}: mean return {np.mean(block):.1f}")
    print(f"greedy policy: mean return {evaluate(env, agent.greedy_action, 100):.1f} over 100 episodes")


if __name__ == "__main__":
    main()
