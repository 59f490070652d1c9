"""The action rule: what to do with the values of the neighbours."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch as th

from sb3_knntd.exploration import Exploration, Softmax, greedy
from sb3_knntd.kernels.step import EPSILON_GREEDY, EXPECTED_SARSA, Q_LEARNING, SARSA, SOFTMAX


class Choice(NamedTuple):
    """
    An action for each row, with what learning needs to know of it.

    :param actions: index of the action, shape (batch,), int64
    :param entries: the column of the table that each neighbour answers for, shape (batch, k), int64
    :param values: what the state is worth as a target, shape (batch,), the table's dtype
    """

    actions: th.Tensor
    entries: th.Tensor
    values: th.Tensor


class ActionRule(Protocol):
    """Chooses from the rows of the neighbours."""

    #: uniform random numbers a choice takes
    n_uniforms: int

    def choose(self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float) -> Choice:
        """
        The action to take while training.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k), the table's dtype
        :param uniforms: random numbers in [0, 1), shape (batch, n_uniforms)
        :param rate: ε or the temperature
        """
        ...

    def best(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        """
        The action to take without exploring, ties to the lowest index.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k), the table's dtype
        """
        ...


def mean_rows(rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
    """
    Q(s, ·) = Σ p(i) Q(i, ·) (eq. 8).

    :param rows: table rows of the neighbours, shape (batch, k, n_actions)
    :param probabilities: of the neighbours, shape (batch, k)
    :return: shape (batch, n_actions)
    """
    return (probabilities[..., None] * rows).sum(dim=1)


class DiscreteRule:
    """
    kNN-TD's rule: the neighbours' values are averaged, and one action is chosen from the average
    (eqs. 8 to 12).

    :param target: ``"sarsa"`` (eq. 11), ``"q_learning"`` (eq. 12) or ``"expected_sarsa"``
    :param exploration: the policy while training
    :param random_ties: whether equal best actions are drawn from while training
    """

    def __init__(self, target: str, exploration: Exploration, random_ties: bool) -> None:
        self.target = target
        self.exploration = exploration
        self.random_ties = random_ties
        self.n_uniforms = exploration.N_UNIFORMS

    def kernel_arguments(self) -> tuple[int, int, bool]:
        """
        :return: ``rule`` of :func:`sb3_knntd.kernels.step.choose`
        """
        target = {"sarsa": SARSA, "q_learning": Q_LEARNING, "expected_sarsa": EXPECTED_SARSA}[self.target]
        exploration = SOFTMAX if isinstance(self.exploration, Softmax) else EPSILON_GREEDY
        return target, exploration, self.random_ties

    def choose(self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float) -> Choice:
        values = mean_rows(rows, probabilities)
        actions = self.exploration.choose(values, uniforms, rate, self.random_ties)
        if self.target == "sarsa":
            worth = values.gather(1, actions[:, None])[:, 0]
        elif self.target == "q_learning":
            worth = values.amax(dim=1)
        else:
            worth = self.exploration.expectation(values, rate)
        return Choice(actions, actions[:, None].expand(probabilities.shape), worth)

    def best(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        return greedy(mean_rows(rows, probabilities))
