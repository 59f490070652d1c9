"""Ex⟨a⟩(lambda) written for reading: plain NumPy, one environment after the other, whole arrays.

As `reference.py` for kNN-TD(lambda): nothing here is fast and nothing is shared with the package. Equation numbers
are those of Martin H., de Lope and Maravall (Neurocomputing 74, 2011), whose Algorithm 4 this is.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from reference import Array, Neighbours, Perceiver, Rates, shared_step


class Choice(NamedTuple):
    """What each neighbour answers for: a column in each part of the table, shape (k, n_parts)."""

    neighbours: Neighbours
    entries: NDArray[np.int64]


@dataclass
class Transition:
    """One step of one environment; at the end of an episode ``next_state`` is the true last observation."""

    choice: Choice
    reward: float
    next_state: Any
    terminated: bool = False
    truncated: bool = False


class ReferenceExA:
    """Algorithm 4, with the table shared by ``n_envs`` environments that keep their own traces.

    :param lists: the action points of each action dimension
    :param factored: whether each dimension has a part of the table to itself; else there is one part, with a column
        for each combination of the points
    """

    def __init__(
        self,
        perceive: Perceiver,
        lists: Sequence[Sequence[float]],
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
        # The action points of each part, one a row: vectors of all dimensions, or numbers of one.
        self.parts: list[Array] = (
            [np.array(points, dtype=np.float64)[:, None] for points in lists]
            if factored
            else [np.array(list(itertools.product(*lists)), dtype=np.float64)]
        )
        self.tables: list[Array] = [np.full((perceive.n_points, len(part)), initial_value) for part in self.parts]
        self.traces: list[Array] = [np.zeros((n_envs, *table.shape)) for table in self.tables]

    @property
    def q_table(self) -> Array:
        """All parts side by side."""
        return np.concatenate(self.tables, axis=1)

    def recommend(self, state: Any) -> Choice:
        """Eq. 20: each neighbour's own best column in each part; of several best the first."""
        neighbours = self.perceive(state)
        best = [table[neighbours.indices].argmax(axis=1) for table in self.tables]
        return Choice(neighbours, np.stack(best, axis=1))

    def action(self, choice: Choice) -> Array:
        """Eq. 21."""
        p = choice.neighbours.probabilities
        means = [
            (p[:, None] * part[column]).sum(axis=0) for part, column in zip(self.parts, choice.entries.T, strict=True)
        ]
        # Each part speaks for one dimension, or the only part for all.
        return np.concatenate(means)

    def worth(self, neighbours: Neighbours) -> float:
        """Eq. 25: the mean of the neighbours' best values."""
        indices, p = neighbours
        return float(np.mean([np.sum(p * table[indices].max(axis=1)) for table in self.tables]))

    def td_error(self, step: Transition) -> float:
        """Eq. 24, both states by eq. 25."""
        ahead = 0.0 if step.terminated else self.worth(self.perceive(step.next_state))
        return step.reward + self.gamma * ahead - self.worth(step.choice.neighbours)

    def mark(self, env: int, choice: Choice) -> None:
        """Eq. 26: one environment's traces become aware of what its neighbours answered for."""
        indices, p = choice.neighbours
        for traces, column in zip(self.traces, choice.entries.T, strict=True):
            if self.trace_kind == "accumulating":
                traces[env, indices, column] += p
                continue
            if self.reset_other_actions:
                traces[env, indices, :] = 0.0
            traces[env, indices, column] = p

    def learn(self, steps: Sequence[Transition], rates: Rates) -> None:
        """One step of every environment."""
        # All errors before any change: no environment sees what another one has just learned.
        corrections = np.array([rates.learning_rate * self.td_error(step) for step in steps])
        if self.step_size == "normalized":
            corrections /= [np.sum(step.choice.neighbours.probabilities**2) for step in steps]
        for env, step in enumerate(steps):
            self.mark(env, step.choice)
        for table, traces in zip(self.tables, self.traces, strict=True):
            table += shared_step(traces, corrections)
            traces *= self.gamma * rates.trace_decay
            for env, step in enumerate(steps):
                if step.terminated or step.truncated:
                    traces[env] = 0.0
