"""
Ex⟨a⟩(λ) from scratch: kNN-TD(λ) with continuous actions in plain NumPy, and a training loop that solves Mountain-Car
with a continuous force.

    python examples/exa_from_scratch.py [--episodes 40] [--seed 0]

Read knn_td_from_scratch.py first, which defines perception and the update of the table. Equation and algorithm numbers
are those of Martin H., de Lope and Maravall, "Robust high performance reinforcement learning through weighted k-nearest
neighbors" (Neurocomputing 74, 2011). The code is not optimised, and shares nothing with the package. The tests compare
the package with this file.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from knn_td_from_scratch import Array, NearestPoints, Neighbours, Perceiver, Rates, evaluate, shared_step
from numpy.typing import NDArray

# --------------------------------------------------------------------------------------------------- 1. the agent
#
# The table has one column for each of a few action points. Every neighbour recommends one action point, and the action
# is the mean of the recommendations, weighted by p. With several action dimensions the table has either a single part,
# with one column for each combination of action points, or one part per dimension.


class Choice(NamedTuple):
    """
    The recommendations of the neighbours.

    :param neighbours: the perception of the observation
    :param columns: the recommended column in each part of the table, shape (k, n_parts)
    """

    neighbours: Neighbours
    columns: NDArray[np.int64]


@dataclass
class Transition:
    """
    One step of one environment.

    :param choice: the recommendations that gave the action
    :param next_state: the observation after the step; at the end of an episode its last observation, not the first one
        of the next episode
    """

    choice: Choice
    reward: float
    next_state: Any
    terminated: bool = False
    truncated: bool = False


class ExAAgent:
    """
    Algorithm 4, with one table for ``n_envs`` environments, each of which has its own traces.

    :param perceive: maps an observation to its neighbours
    :param action_points: the action points of each action dimension (eq. 19)
    :param factored: whether each dimension has its own part of the table, or one part holds all combinations
    :param gamma: discount factor
    :param traces: ``"replacing"`` or ``"accumulating"``
    :param reset_other_actions: whether replacing traces clear those of the columns that were not recommended
    :param step_size: ``"paper"`` for α, or ``"normalized"`` for α / Σp²
    """

    def __init__(
        self,
        perceive: Perceiver,
        action_points: Sequence[Sequence[float]],
        n_envs: int = 1,
        *,
        factored: bool = False,
        gamma: float = 0.99,
        traces: str = "replacing",
        reset_other_actions: bool = False,
        step_size: str = "normalized",
        initial_value: float = 0.0,
    ) -> None:
        self.perceive = perceive
        self.factored = factored
        self.gamma = gamma
        self.trace_kind = traces
        self.reset_other_actions = reset_other_actions
        self.step_size = step_size
        # The action of each column of each part, shape (n_columns, n_dims of the part).
        self.parts: list[Array] = (
            [np.array(points, dtype=np.float64)[:, None] for points in action_points]
            if factored
            else [np.array(list(itertools.product(*action_points)), dtype=np.float64)]
        )
        self.tables: list[Array] = [np.full((perceive.n_points, len(part)), initial_value) for part in self.parts]
        self.traces: list[Array] = [np.zeros((n_envs, *table.shape)) for table in self.tables]

    @property
    def q_table(self) -> Array:
        """All parts side by side, shape (n_points, n_columns of all parts)."""
        return np.concatenate(self.tables, axis=1)

    # Acting

    def recommend(self, state: Any) -> Choice:
        """Eq. 20: every neighbour recommends the best column of its own row, the first in case of ties."""
        neighbours = self.perceive(state)
        best = [table[neighbours.indices].argmax(axis=1) for table in self.tables]
        return Choice(neighbours, np.stack(best, axis=1))

    def explore(self, choice: Choice, epsilon: float, rng: np.random.Generator) -> Choice:
        """With probability ε all neighbours recommend the same random column instead."""
        if rng.random() >= epsilon:
            return choice
        column = [rng.integers(len(part)) for part in self.parts]
        return Choice(choice.neighbours, np.tile(column, (len(choice.columns), 1)))

    def action(self, choice: Choice) -> Array:
        """Eq. 21: the weighted mean of the recommendations, shape (n_dims,)."""
        p = choice.neighbours.probabilities
        means = [
            (p[:, None] * part[column]).sum(axis=0) for part, column in zip(self.parts, choice.columns.T, strict=True)
        ]
        return np.concatenate(means)

    # Learning

    def state_value(self, neighbours: Neighbours) -> float:
        """Eq. 25: the weighted mean of the neighbours' best values, averaged over the parts."""
        indices, p = neighbours
        return float(np.mean([np.sum(p * table[indices].max(axis=1)) for table in self.tables]))

    def td_error(self, step: Transition) -> float:
        """Eq. 24: δ. The value after a terminal state is 0; after a truncation the target bootstraps."""
        next_value = 0.0 if step.terminated else self.state_value(self.perceive(step.next_state))
        return step.reward + self.gamma * next_value - self.state_value(step.choice.neighbours)

    def set_traces(self, env: int, choice: Choice) -> None:
        """Eq. 26: set the trace of every neighbour at the column that it recommended."""
        indices, p = choice.neighbours
        for traces, column in zip(self.traces, choice.columns.T, strict=True):
            if self.trace_kind == "accumulating":
                traces[env, indices, column] += p
            elif self.trace_kind == "replacing":
                if self.reset_other_actions:
                    traces[env, indices, :] = 0.0
                traces[env, indices, column] = p
            else:
                raise ValueError(self.trace_kind)

    def alpha(self, step: Transition, rates: Rates) -> float:
        """The step size."""
        if self.step_size == "paper":
            return rates.learning_rate
        if self.step_size == "normalized":
            return float(rates.learning_rate / np.sum(step.choice.neighbours.probabilities**2))
        raise ValueError(self.step_size)

    def learn(self, steps: Sequence[Transition], rates: Rates) -> None:
        """Learn from one step of every environment."""
        # Compute all errors before the update: no environment uses values that another has just updated.
        scaled_errors = np.array([self.alpha(step, rates) * self.td_error(step) for step in steps])
        for env, step in enumerate(steps):
            self.set_traces(env, step.choice)
        for table, traces in zip(self.tables, self.traces, strict=True):
            table += shared_step(traces, scaled_errors)
            traces *= self.gamma * rates.trace_decay
            for env, step in enumerate(steps):
                if step.terminated or step.truncated:
                    traces[env] = 0.0


# ------------------------------------------------------------------------------------------------- 2. training


def train(env: gym.Env[Any, Any], agent: ExAAgent, rates: Rates, n_episodes: int, seed: int) -> list[float]:
    """Algorithm 4 in one environment, with ε decreasing to 0 over the episodes. Returns the return of each episode."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    returns = []
    for episode in range(n_episodes):
        epsilon = rates.epsilon * (1.0 - episode / n_episodes)
        state, _ = env.reset()
        total, terminated, truncated = 0.0, False, False
        while not (terminated or truncated):
            choice = agent.explore(agent.recommend(state), epsilon, rng)
            state, reward, terminated, truncated, _ = env.step(agent.action(choice))
            agent.learn([Transition(choice, float(reward), state, terminated, truncated)], rates)
            total += float(reward)
        returns.append(total)
    return returns


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    env = gym.make("MountainCarContinuous-v0")
    space = env.observation_space
    assert isinstance(space, spaces.Box)
    perceive = NearestPoints((15, 15), (space.low, space.high), 16, weights="gaussian", bandwidth=0.15)
    agent = ExAAgent(perceive, [np.linspace(-1.0, 1.0, 11).tolist()], initial_value=50.0)
    rates = Rates(learning_rate=0.3, trace_decay=0.98, epsilon=0.1)
    returns = train(env, agent, rates, arguments.episodes, arguments.seed)
    for start in range(0, len(returns), 10):
        block = returns[start : start + 10]
        print(f"episodes {start + 1} to {start + len(block)}: mean return {np.mean(block):.1f}")
    mean = evaluate(env, lambda state: agent.action(agent.recommend(state)), 100)
    print(f"greedy policy: mean return {mean:.1f} over 100 episodes")


if __name__ == "__main__":
    main()
