"""The action rule: what to do with the values of the neighbours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.actions.exploration import Exploration, Softmax, greedy, pick
from sb3_knntd.kernels.step import (
    AVERAGE,
    EACH,
    EPSILON_GREEDY,
    EXPECTED_SARSA,
    GREEDY,
    PER_NEIGHBOR,
    Q_LEARNING,
    SARSA,
    SHARED,
    SOFTMAX,
    UNDRAWN,
)


class Choice(NamedTuple):
    """
    An action for each row, with what learning needs to know of it.

    :param actions: the action: its index, shape (batch,), int64, or a vector, shape (batch, action_dim)
    :param entries: the columns of the table that each neighbour answers for, one for each of the action's parts,
        shape (batch, k, n_blocks), int64
    :param values: what the state is worth as a target, shape (batch,), the table's dtype
    """

    actions: th.Tensor
    entries: th.Tensor
    values: th.Tensor


class ActionRule(ABC):
    """Chooses from the rows of the neighbours."""

    #: uniform random numbers a choice takes
    n_uniforms: int
    #: where the columns of each of the action's parts begin, and the end, shape (n_blocks + 1,), int64
    blocks: np.ndarray

    @abstractmethod
    def hold(self, held: th.Tensor, uniforms: th.Tensor, rate: float, lengths: th.Tensor) -> th.Tensor:
        """
        What is being explored, now that a step has passed.

        :param held: the columns being explored, or ``GREEDY`` or ``UNDRAWN``, shape (batch, n_blocks), int64
        :param uniforms: random numbers in [0, 1), shape (batch, n_uniforms)
        :param rate: ε or the temperature
        :param lengths: how many steps each episode is taken to last, shape (batch,)
        :return: the same, shape (batch, n_blocks)
        """

    @abstractmethod
    def choose(
        self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float, held: th.Tensor
    ) -> Choice:
        """
        The action to take while training.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k), the table's dtype
        :param uniforms: random numbers in [0, 1), shape (batch, n_uniforms)
        :param rate: ε or the temperature
        :param held: see :meth:`hold`
        """

    @abstractmethod
    def value(self, rows: th.Tensor, probabilities: th.Tensor, entries: th.Tensor) -> th.Tensor:
        """
        What a state and the action taken in it are worth by the table as it is.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k), the table's dtype
        :param entries: the columns that were answered for, shape (batch, k, n_blocks)
        :return: shape (batch,)
        """

    @abstractmethod
    def kernel_arguments(self) -> tuple[Any, ...]:
        """
        :return: ``RULE`` of :mod:`sb3_knntd.kernels.desk`
        """


def mean_rows(rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
    """
    Q(s, ·) = Σ p(i) Q(i, ·) (eq. 8).

    :param rows: table rows of the neighbours, shape (batch, k, n_actions)
    :param probabilities: of the neighbours, shape (batch, k)
    :return: shape (batch, n_actions)
    """
    return (probabilities[..., None] * rows).sum(dim=1)


def mean_actions(entries: th.Tensor, probabilities: th.Tensor, action_points: th.Tensor) -> th.Tensor:
    """
    The mean of what the neighbours recommend (eq. 21).

    :param entries: the columns they recommend, shape (batch, k, n_blocks)
    :param probabilities: of the neighbours, shape (batch, k)
    :param action_points: the action of each column, shape (n_actions, action_dim)
    :return: shape (batch, action_dim)
    """
    return (probabilities[..., None] * action_points[entries].sum(dim=2)).sum(dim=1)


class DiscreteRule(ActionRule):
    """
    kNN-TD's rule: the neighbours' values are averaged, and one action is chosen from the average
    (eqs. 8 to 12).

    :param n_actions: number of actions
    :param target: ``"sarsa"`` (eq. 11), ``"q_learning"`` (eq. 12) or ``"expected_sarsa"``
    :param exploration: the policy while training
    :param random_ties: whether equal best actions are drawn from while training
    """

    def __init__(self, n_actions: int, target: str, exploration: Exploration, random_ties: bool) -> None:
        self.target = target
        self.exploration = exploration
        self.random_ties = random_ties
        self.n_uniforms = exploration.N_UNIFORMS
        self.blocks = np.array([0, n_actions])

    def kernel_arguments(self) -> tuple[Any, ...]:
        target = {"sarsa": SARSA, "q_learning": Q_LEARNING, "expected_sarsa": EXPECTED_SARSA}[self.target]
        exploration = SOFTMAX if isinstance(self.exploration, Softmax) else EPSILON_GREEDY
        return AVERAGE, target, exploration, self.random_ties, 1.0, 0.0, self.blocks, np.empty((0, 0))

    def hold(self, held: th.Tensor, uniforms: th.Tensor, rate: float, lengths: th.Tensor) -> th.Tensor:
        return held

    def choose(
        self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float, held: th.Tensor
    ) -> Choice:
        values = mean_rows(rows, probabilities)
        actions = self.exploration.choose(values, uniforms, rate, self.random_ties)
        if self.target == "sarsa":
            worth = values.gather(1, actions[:, None])[:, 0]
        elif self.target == "q_learning":
            worth = values.amax(dim=1)
        else:
            worth = self.exploration.expectation(values, rate)
        return Choice(actions, actions[:, None, None].expand(*probabilities.shape, 1), worth)

    def value(self, rows: th.Tensor, probabilities: th.Tensor, entries: th.Tensor) -> th.Tensor:
        return (probabilities * rows.gather(2, entries)[..., 0]).sum(dim=1)


class ContinuousRule(ActionRule):
    """
    Ex⟨a⟩'s rule: each neighbour recommends the best action of its own row, and the recommendations are averaged
    (eqs. 19 to 21). What the state is worth is the mean of the neighbours' best values (eq. 25).

    :param action_points: the action of each column, shape (n_actions, action_dim), action units
    :param blocks: where the columns of each of the action's parts begin, and the end, shape (n_blocks + 1,)
    :param shared: whether all neighbours explore the same column together, or each by itself (eq. 27)
    :param least_hold: for how many steps in the mean a draw of whether and what to explore together is held
    :param hold_share: or for this share of an episode, if that is longer
    :param n_neighbors: k
    :param random_ties: whether equal best columns are drawn from while training
    """

    def __init__(
        self,
        action_points: np.ndarray,
        blocks: np.ndarray,
        shared: bool,
        least_hold: float,
        hold_share: float,
        n_neighbors: int,
        random_ties: bool,
    ) -> None:
        self.action_points = action_points
        self.blocks = blocks
        self.shared = shared
        self.least_hold = float(least_hold)
        self.hold_share = float(hold_share)
        self.random_ties = random_ties
        n_blocks = len(blocks) - 1
        #: redraw, explore, column of each block, tie of each neighbour and block, and whether each explores
        self._parts = [1, 1, n_blocks, n_neighbors * n_blocks, 0 if shared else n_neighbors * n_blocks]
        self.n_uniforms = sum(self._parts)

    def kernel_arguments(self) -> tuple[Any, ...]:
        exploration = SHARED if self.shared else PER_NEIGHBOR
        hold = self.least_hold, self.hold_share
        return EACH, SARSA, exploration, self.random_ties, *hold, self.blocks, self.action_points

    def hold(self, held: th.Tensor, uniforms: th.Tensor, rate: float, lengths: th.Tensor) -> th.Tensor:
        if not self.shared:
            return held
        redraw, explore, columns, *_ = uniforms.split(self._parts, dim=1)
        drawn = [
            first + pick(columns[:, block], end - first)
            for block, (first, end) in enumerate(pairwise(self.blocks.tolist()))
        ]
        fresh = th.where(explore < rate, th.stack(drawn, dim=1), GREEDY)
        steps = (self.hold_share * lengths).clamp(min=self.least_hold)
        return th.where((held[:, :1] == UNDRAWN) | (redraw * steps[:, None] < 1.0), fresh, held)

    def choose(
        self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float, held: th.Tensor
    ) -> Choice:
        batch, k, _ = rows.shape
        _, _, _, ties, explore = uniforms.split(self._parts, dim=1)
        ties = ties.reshape(batch, k, -1)
        entries = []
        for block, (first, end) in enumerate(pairwise(self.blocks.tolist())):
            part = rows[..., first:end]
            entry = first + greedy(part, ties[..., block] if self.random_ties else None)
            if self.shared:
                entry = th.where(held[:, block, None] >= 0, held[:, block, None], entry)
            else:
                drawn = first + pick(ties[..., block], end - first)
                entry = th.where(explore.reshape(batch, k, -1)[..., block] < rate, drawn, entry)
            entries.append(entry)
        chosen = th.stack(entries, dim=2)
        points = th.from_numpy(self.action_points).to(probabilities)
        return Choice(mean_actions(chosen, probabilities, points), chosen, self.value(rows, probabilities, chosen))

    def value(self, rows: th.Tensor, probabilities: th.Tensor, entries: th.Tensor) -> th.Tensor:
        best = [rows[..., first:end].amax(dim=-1) for first, end in pairwise(self.blocks.tolist())]
        return (probabilities * th.stack(best, dim=2).mean(dim=2)).sum(dim=1)
