"""kNN-TD(lambda) written for reading: plain NumPy, one environment after the other, whole arrays.

Nothing here is fast and nothing here is shared with the package, so that an error in one is not an error in
both. Equation and line numbers are those of Martin H., de Lope and Maravall (Neurocomputing 74, 2011).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Weights = str | Callable[[Array], Array]


# ---------------------------------------------------------------------------------------------- perception


class Neighbours(NamedTuple):
    """The points that stand for one observation, and how much each of them does."""

    indices: NDArray[np.int64]
    probabilities: Array


class Perceiver(Protocol):
    """What turns one observation into its neighbours."""

    n_points: int

    def __call__(self, observation: ArrayLike) -> Neighbours: ...


def scale(x: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Eq. 4: the range between the bounds becomes [-1, 1]; what lies outside is not clipped."""
    at, start, end = (np.asarray(v, dtype=np.float64) for v in (x, low, high))
    return np.asarray(2.0 * (at - start) / (end - start) - 1.0)


def lattice(sizes: Sequence[int]) -> Array:
    """All points of a regular grid over [-1, 1]^d, the last dimension running fastest."""
    axes = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in sizes), indexing="ij")
    return np.stack([axis.ravel() for axis in axes], axis=1)


def squared_distances(x: Array, points: Array) -> Array:
    """Squared Euclidean distance of one scaled observation to every scaled point."""
    total = np.zeros(len(points))
    # The order of the sum is part of the definition: it decides which distances come out exactly equal.
    for j in range(points.shape[1]):
        total += (x[j] - points[:, j]) ** 2
    return total


def weigh(squared: Array, weights: Weights, bandwidth: float) -> Array:
    """Eq. 5 and its rivals: the weights of the neighbours before they are normalised."""
    if callable(weights):
        return np.asarray(weights(squared), dtype=np.float64)
    if weights == "inverse_quadratic":
        return np.asarray(1.0 / (1.0 + squared / bandwidth**2))
    if weights == "gaussian":
        # A common factor leaves the probabilities as they are, and this one keeps them from being 0 / 0
        # where every exponential is too small for a float.
        return np.asarray(np.exp(-(squared - squared.min()) / (2.0 * bandwidth**2)))
    raise ValueError(weights)


class NearestPoints:
    """Eq. 4 to 6: the k nearest of the given points.

    :param points: one size a dimension (a lattice), or the points themselves, one a row, in observation units
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
        by_distance_then_index = np.lexsort((np.arange(self.n_points), squared))
        nearest = by_distance_then_index[: self.n_neighbors]
        w = weigh(squared[nearest], self.weights, self.bandwidth)
        return Neighbours(nearest, w / w.sum())


class ExactStates:
    """A finite observation space: each state is a point of its own, and its only neighbour."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = tuple(int(n) for n in sizes)
        self.n_points = int(np.prod(self.sizes))

    def __call__(self, observation: ArrayLike) -> Neighbours:
        coordinates = np.asarray(observation, dtype=np.int64).reshape(len(self.sizes))
        index = np.ravel_multi_index(tuple(coordinates), self.sizes)
        return Neighbours(np.array([index]), np.array([1.0]))


def make_perceiver(space: spaces.Space[Any], **settings: Any) -> Perceiver:
    """The perceiver that an observation space asks for; the settings are those of `NearestPoints`."""
    if isinstance(space, spaces.Discrete):
        return ExactStates([int(space.n)])
    if isinstance(space, spaces.MultiDiscrete):
        return ExactStates([int(n) for n in space.nvec])
    return NearestPoints(**settings)


# ------------------------------------------------------------------------------------------------ learning


@dataclass
class Transition:
    """One step of one environment.

    :param next_state: the observation the step led to; at the end of an episode the true last one
    :param next_action: the action chosen there; ``None`` for the greedy one
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
    """What may change from one step to the next."""

    learning_rate: float
    trace_decay: float
    epsilon: float = 0.0
    temperature: float = 1.0


def shared_step(traces: Array, scaled_errors: Array) -> Array:
    """What the table gains from the errors of all environments together.

    Each entry takes the eligibility-weighted mean of the errors, times the largest eligibility there: many
    environments in the same cells agree on a step instead of adding theirs up. One environment alone gives
    eq. 14.

    :param traces: (n_envs, n_points, n_actions)
    :param scaled_errors: (n_envs,), alpha times the TD error
    """
    total = traces.sum(axis=0)
    largest = traces.max(axis=0)
    share = np.divide(largest, total, out=np.zeros_like(total), where=total > 0)
    summed = (scaled_errors[:, None, None] * traces).sum(axis=0)
    return np.asarray(share * summed)


class ReferenceKNNTD:
    """Algorithm 3, with the table shared by ``n_envs`` environments that keep their own traces."""

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

    def q_values(self, state: Any) -> Array:
        """Eq. 8, for every action."""
        indices, p = self.perceive(state)
        # Not a matrix product: every action's sum must be taken in the same order, or equal values would
        # come out unequal and the tie be broken by rounding.
        return np.asarray((p[:, None] * self.q_table[indices]).sum(axis=0))

    def greedy_action(self, state: Any) -> int:
        """Eq. 9; of several best actions the first."""
        return int(np.argmax(self.q_values(state)))

    def expected_value(self, state: Any, rates: Rates) -> float:
        """The mean of Q at a state under the policy that explores."""
        q = self.q_values(state)
        if self.exploration == "epsilon_greedy":
            return float((1.0 - rates.epsilon) * q.max() + rates.epsilon * q.mean())
        if self.exploration == "softmax":
            preferences = np.exp((q - q.max()) / rates.temperature)
            return float(preferences @ q / preferences.sum())
        raise ValueError(self.exploration)

    def next_value(self, step: Transition, rates: Rates) -> float:
        """What the target takes the state after the step to be worth."""
        if step.terminated:
            return 0.0
        q = self.q_values(step.next_state)
        if self.target == "sarsa":
            chosen = self.greedy_action(step.next_state) if step.next_action is None else step.next_action
            return float(q[chosen])
        if self.target == "q_learning":
            return float(q.max())
        if self.target == "expected_sarsa":
            return self.expected_value(step.next_state, rates)
        raise ValueError(self.target)

    def td_error(self, step: Transition, rates: Rates) -> float:
        """Eq. 11 or 12."""
        expected = self.q_values(step.state)[step.action]
        return float(step.reward + self.gamma * self.next_value(step, rates) - expected)

    def mark(self, env: int, step: Transition) -> None:
        """Eq. 15 or 16: one environment's traces become aware of the state and action of this step."""
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
        """The step size, which may be counted as a share of the error at the state."""
        if self.step_size == "paper":
            return rates.learning_rate
        if self.step_size == "normalized":
            return float(rates.learning_rate / np.sum(self.perceive(step.state).probabilities ** 2))
        raise ValueError(self.step_size)

    def learn(self, steps: Sequence[Transition], rates: Rates) -> None:
        """Lines 15 to 20 for one step of every environment."""
        # All errors before any change: no environment sees what another one has just learned.
        errors = np.array([self.td_error(step, rates) for step in steps])
        alphas = np.array([self.alpha(step, rates) for step in steps])
        for env, step in enumerate(steps):
            self.mark(env, step)
        self.q_table += shared_step(self.traces, alphas * errors)
        self.traces *= self.gamma * rates.trace_decay
        for env, step in enumerate(steps):
            if step.terminated or step.truncated:
                self.traces[env] = 0.0
