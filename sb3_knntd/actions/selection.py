"""Action selection: from the values of the neighbours to an action and the value of the state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.actions.columns import ActionColumns
from sb3_knntd.actions.exploration import ExplorationPolicy, greedy, pick
from sb3_knntd.actions.rules import Rules
from sb3_knntd.common.checks import check_member
from sb3_knntd.kernels.selection import (
    GREEDY,
    UNDRAWN,
    Combination,
    Exploration,
    SelectionArguments,
    Target,
)


class Selection(NamedTuple):
    """
    The selected actions, and the values needed to learn from them.

    :param actions: indices of actions, shape (batch,), int64, or vectors, shape (batch, action_dim)
    :param action_indices: the column that each neighbour selects for each action factor, shape (batch, k, n_factors),
        int64
    :param target_values: values of the states as targets, shape (batch,), the table's dtype
    """

    actions: th.Tensor
    action_indices: th.Tensor
    target_values: th.Tensor


class ActionSelector(ABC):
    """
    Selects actions from the rows of the neighbours. With :meth:`kernel_arguments`, the kernels select in the same way.

    In the rows, forbidden actions have the value -inf.

    :param columns: the actions that the columns of the table stand for
    :param random_ties: whether ties between best actions are broken at random while training, otherwise the first is
        taken
    :param rules: where actions are forbidden; nowhere by default
    """

    #: number of uniform random numbers used for one selection
    n_uniforms: int
    _COMBINATION: ClassVar[Combination]
    #: an exploration that is greedy at a rate of 0
    _GREEDY_EXPLORATION: ClassVar[Exploration]
    target = Target.SARSA
    exploration: Exploration
    #: whether greedy actions are peaks between the action points, see :class:`~sb3_knntd.actions.peak.PeakSelector`
    interpolates: ClassVar[bool] = False
    min_persistence = 1.0
    persistence_share = 0.0

    def __init__(self, columns: ActionColumns, random_ties: bool, rules: Rules | None = None) -> None:
        self.columns = columns
        self.random_ties = random_ties
        self.rules = Rules(0, int(columns.factors[-1])) if rules is None else rules

    @property
    def n_factors(self) -> int:
        """Number of action factors, each with its own columns of the table."""
        return len(self.columns.factors) - 1

    @property
    def averages_values(self) -> bool:
        """Whether the mean values of the neighbours decide; if not, each neighbour decides by its own."""
        return self._COMBINATION is Combination.OF_VALUES

    @property
    def rate_is_temperature(self) -> bool:
        """Whether the rate of exploration is a temperature; if not, it is ε."""
        return self.exploration is Exploration.SOFTMAX

    @property
    def factor_ranges(self) -> list[tuple[int, int]]:
        """The first column of each action factor, and the one after its last."""
        return list(pairwise(self.columns.factors.tolist()))

    def kernel_arguments(self, greedy: bool = False) -> SelectionArguments:
        """
        :param greedy: whether to select greedily, the first of equal actions
        :return: arguments with which the kernels select in the same way; with ``greedy``, call them with a rate of 0
        """
        return SelectionArguments(
            combination=int(self._COMBINATION),
            target=int(self.target),
            exploration=int(self._GREEDY_EXPLORATION if greedy else self.exploration),
            random_ties=self.random_ties and not greedy,
            min_persistence=self.min_persistence,
            persistence_share=self.persistence_share,
            factors=self.columns.factors,
            action_points=self.columns.points,
            **self.rules.kernel_arguments(),
        )

    def persist(self, persistent: th.Tensor, uniforms: th.Tensor, rate: float, lengths: th.Tensor) -> th.Tensor:
        """
        Keep or redraw the persistent actions for the next step.

        :param persistent: the columns being explored, or ``GREEDY`` or ``UNDRAWN``, shape (batch, n_factors), int64
        :param uniforms: random numbers in [0, 1), shape (batch, n_uniforms)
        :param rate: ε or the temperature
        :param lengths: expected length of each episode, steps, shape (batch,)
        :return: the new persistent actions, shape (batch, n_factors), int64
        """
        return persistent

    @abstractmethod
    def select(
        self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float, persistent: th.Tensor
    ) -> Selection:
        """
        Select the actions to take while training.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k), the table's dtype
        :param uniforms: random numbers in [0, 1), shape (batch, n_uniforms)
        :param rate: ε or the temperature
        :param persistent: see :meth:`persist`
        """

    @abstractmethod
    def greedy_indices(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        """
        The columns that the neighbours select greedily, the first of equal ones.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k)
        :return: shape (batch, k, n_factors), int64
        """

    @abstractmethod
    def actions_of(self, action_indices: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        """
        The action that selected columns stand for.

        :param action_indices: shape (batch, k, n_factors), int64
        :param probabilities: of the neighbours, shape (batch, k)
        :return: indices of actions, shape (batch,), int64, or vectors, shape (batch, action_dim), action units
        """

    def greedy_actions(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        """
        The greedy action.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k)
        :return: indices of actions, shape (batch,), int64, or vectors, shape (batch, action_dim), action units
        """
        return self.actions_of(self.greedy_indices(rows, probabilities), probabilities)

    @abstractmethod
    def columns_of(self, actions: np.ndarray) -> np.ndarray:
        """
        The columns of given actions, or of the nearest action points.

        :param actions: indices of actions, shape (n,), or vectors, shape (n, action_dim), action units
        :return: shape (n, n_factors), int64
        :raises ValueError: if there is no such action
        """

    @abstractmethod
    def value(
        self,
        rows: th.Tensor,
        probabilities: th.Tensor,
        action_indices: th.Tensor,
        allowed: th.Tensor | None = None,
    ) -> th.Tensor:
        """
        The current value of a state and the action taken in it (eqs. 8 and 25).

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k), the table's dtype
        :param action_indices: the columns that were selected, shape (batch, k, n_factors)
        :param allowed: the same rows with -inf at forbidden actions; by default ``rows``
        :return: shape (batch,)
        """

    @abstractmethod
    def greedy_value(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        """
        The value of a state if the greedy action is taken (eqs. 12 and 25).

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k)
        :return: shape (batch,)
        """

    def given_value(self, rows: th.Tensor, probabilities: th.Tensor, columns: th.Tensor) -> th.Tensor:
        """
        The value of a state and a given action, the same for all neighbours.

        :param rows: table rows of the neighbours, shape (batch, k, n_actions)
        :param probabilities: of the neighbours, shape (batch, k)
        :param columns: a column for each action factor, shape (batch, n_factors), int64
        :return: shape (batch,)
        """
        chosen = [
            rows.gather(2, columns[:, None, [factor]].expand(*rows.shape[:2], 1)) for factor in range(self.n_factors)
        ]
        return (probabilities * th.cat(chosen, dim=2).mean(dim=2)).sum(dim=1)

    def random_columns(self, uniforms: np.ndarray, observations: np.ndarray) -> np.ndarray:
        """
        Draw columns uniformly at random from those that are allowed.

        :param uniforms: random numbers in [0, 1), shape (batch, n_factors)
        :param observations: the states to act in, shape (batch, *obs_shape), observation units
        :return: a column for each action factor, shape (batch, n_factors), int64
        """
        allowed = ~self.rules.forbidden(th.from_numpy(observations)).cpu()
        ranks = th.from_numpy(uniforms)
        drawn: np.ndarray = th.stack(
            [first + greedy(allowed[:, first:end], ranks[:, f]) for f, (first, end) in enumerate(self.factor_ranges)],
            dim=1,
        ).numpy()
        return drawn


def mean_rows(rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
    """
    Q(s, ·) = Σ p(i) Q(i, ·) (eq. 8).

    :param rows: table rows of the neighbours, shape (batch, k, n_actions)
    :param probabilities: of the neighbours, shape (batch, k)
    :return: shape (batch, n_actions)
    """
    return (probabilities[..., None] * rows).sum(dim=1)


class MeanValueSelector(ActionSelector):
    """
    kNN-TD: the neighbours' values are averaged, and one action is selected from the mean (eqs. 8 to 12).

    :param columns: one for each action
    :param target: kind of the target value
    :param exploration: the policy while training
    :param random_ties: whether ties between best actions are broken at random while training, otherwise the first is
        taken
    :param rules: where actions are forbidden; nowhere by default
    """

    _COMBINATION = Combination.OF_VALUES
    _GREEDY_EXPLORATION = Exploration.EPSILON_GREEDY

    def __init__(
        self,
        columns: ActionColumns,
        target: Target,
        exploration: ExplorationPolicy,
        random_ties: bool,
        rules: Rules | None = None,
    ) -> None:
        super().__init__(columns, random_ties, rules)
        self.target = target
        self.policy = exploration
        self.exploration = exploration.CODE
        self.n_uniforms = exploration.N_UNIFORMS

    def kernel_arguments(self, greedy: bool = False) -> SelectionArguments:
        # An inherited CODE would make the kernels explore like the parent class.
        if not greedy and "CODE" not in vars(type(self.policy)):
            raise ValueError(
                f"the compiled step does not know the exploration {type(self.policy).__name__}: its CODE must be set "
                "in the class itself, to a member of Exploration that the kernels implement. Without it, give "
                "policy_kwargs={'compiled': False}"
            )
        return super().kernel_arguments(greedy)

    def select(
        self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float, persistent: th.Tensor
    ) -> Selection:
        values = mean_rows(rows, probabilities)
        actions = self.policy.choose(values, uniforms, rate, self.random_ties)
        if self.target is Target.SARSA:
            target_values = values.gather(1, actions[:, None])[:, 0]
        elif self.target is Target.Q_LEARNING:
            target_values = values.amax(dim=1)
        elif self.target is Target.EXPECTED_SARSA:
            target_values = self.policy.expectation(values, rate)
        else:
            raise ValueError(f"there is no target {self.target!r}")
        return Selection(actions, actions[:, None, None].expand(*probabilities.shape, 1), target_values)

    def greedy_indices(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        return greedy(mean_rows(rows, probabilities))[:, None, None].expand(*probabilities.shape, 1)

    def actions_of(self, action_indices: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        return action_indices[:, 0, 0]

    def columns_of(self, actions: np.ndarray) -> np.ndarray:
        columns = np.asarray(actions)
        n_actions = int(self.columns.factors[-1])
        if columns.ndim != 1 or not np.issubdtype(columns.dtype, np.integer):
            raise ValueError(f"actions must be integers of shape (n,); got {columns.dtype}, shape {columns.shape}")
        if len(columns) and not 0 <= columns.min() <= columns.max() < n_actions:
            raise ValueError(f"actions must be from 0 to {n_actions - 1}; got {columns.min()} to {columns.max()}")
        return columns[:, None].astype(np.int64)

    def value(
        self,
        rows: th.Tensor,
        probabilities: th.Tensor,
        action_indices: th.Tensor,
        allowed: th.Tensor | None = None,
    ) -> th.Tensor:
        return (probabilities * rows.gather(2, action_indices)[..., 0]).sum(dim=1)

    def greedy_value(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        return mean_rows(rows, probabilities).amax(dim=1)

    def given_value(self, rows: th.Tensor, probabilities: th.Tensor, columns: th.Tensor) -> th.Tensor:
        # Same rounding as in greedy_value, with which it is compared.
        return mean_rows(rows, probabilities).gather(1, columns)[:, 0]


class MeanActionSelector(ActionSelector):
    """
    Ex⟨a⟩: each neighbour selects the best action of its own row, and the mean of these actions is taken (eqs. 19 to
    21). The value of the state is the mean of the neighbours' best values (eq. 25).

    :param columns: the action points, in columns for each action factor
    :param exploration: ``SHARED``: all neighbours explore the same column; ``PER_NEIGHBOR``: each draws its own (eq.
        27)
    :param min_persistence: lower limit of the mean number of steps for which a shared draw is kept
    :param persistence_share: share of an episode for which a shared draw is kept on average, if that is longer
    :param n_neighbors: k
    :param random_ties: whether ties between best columns are broken at random while training, otherwise the first is
        taken
    :param rules: where columns are forbidden; nowhere by default
    """

    _COMBINATION = Combination.OF_ACTIONS
    _GREEDY_EXPLORATION = Exploration.SHARED

    def __init__(
        self,
        columns: ActionColumns,
        exploration: Exploration,
        min_persistence: float,
        persistence_share: float,
        n_neighbors: int,
        random_ties: bool,
        rules: Rules | None = None,
    ) -> None:
        super().__init__(columns, random_ties, rules)
        self.exploration = check_member("exploration", exploration, (Exploration.SHARED, Exploration.PER_NEIGHBOR))
        self.min_persistence = float(min_persistence)
        self.persistence_share = float(persistence_share)
        n_factors, shared = self.n_factors, exploration is Exploration.SHARED
        #: number of uniforms for: redraw, explore, column of each factor, tie of each neighbour and factor, and whether
        #: each neighbour explores each factor
        self._parts = [1, 1, n_factors, n_neighbors * n_factors, 0 if shared else n_neighbors * n_factors]
        self.n_uniforms = sum(self._parts)
        self._points = th.from_numpy(columns.points)

    def persist(self, persistent: th.Tensor, uniforms: th.Tensor, rate: float, lengths: th.Tensor) -> th.Tensor:
        if self.exploration is not Exploration.SHARED:
            return persistent
        redraw, explore, columns, *_ = uniforms.split(self._parts, dim=1)
        drawn = [first + pick(columns[:, f], end - first) for f, (first, end) in enumerate(self.factor_ranges)]
        fresh = th.where(explore < rate, th.stack(drawn, dim=1), GREEDY)
        steps = (self.persistence_share * lengths).clamp(min=self.min_persistence)
        return th.where((persistent[:, :1] == UNDRAWN) | (redraw * steps[:, None] < 1.0), fresh, persistent)

    def select(
        self, rows: th.Tensor, probabilities: th.Tensor, uniforms: th.Tensor, rate: float, persistent: th.Tensor
    ) -> Selection:
        batch, k, _ = rows.shape
        _, _, _, ties, explore = uniforms.split(self._parts, dim=1)
        ties = ties.reshape(batch, k, -1)
        selected = []
        for factor, (first, end) in enumerate(self.factor_ranges):
            column = first + greedy(rows[..., first:end], ties[..., factor] if self.random_ties else None)
            if self.exploration is Exploration.SHARED:
                drawn = persistent[:, factor, None].expand(batch, k)
                explores = drawn >= 0
            else:
                drawn = first + pick(ties[..., factor], end - first)
                explores = explore.reshape(batch, k, -1)[..., factor] < rate
            is_allowed = rows.gather(2, drawn.clamp(min=0)[..., None])[..., 0] > -th.inf
            selected.append(th.where(explores & is_allowed, drawn, column))
        action_indices = th.stack(selected, dim=2)
        actions = self.actions_of(action_indices, probabilities)
        return Selection(actions, action_indices, self.greedy_value(rows, probabilities))

    def greedy_indices(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        return th.stack([first + greedy(rows[..., first:end]) for first, end in self.factor_ranges], dim=2)

    def actions_of(self, action_indices: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        points = self._points.to(probabilities)
        return (probabilities[..., None] * points[action_indices].sum(dim=2)).sum(dim=1)

    def greedy_actions(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        points = self._points.to(probabilities)[self.greedy_indices(rows, probabilities)].sum(dim=2)
        # Added one after the other, as in the kernels, so that both are rounded in the same way.
        return (probabilities[..., None] * points).cumsum(dim=1)[:, -1]

    def columns_of(self, actions: np.ndarray) -> np.ndarray:
        return self.columns.nearest(actions)

    def value(
        self,
        rows: th.Tensor,
        probabilities: th.Tensor,
        action_indices: th.Tensor,
        allowed: th.Tensor | None = None,
    ) -> th.Tensor:
        return self.greedy_value(rows if allowed is None else allowed, probabilities)

    def greedy_value(self, rows: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
        best = [rows[..., first:end].amax(dim=-1) for first, end in self.factor_ranges]
        return (probabilities * th.stack(best, dim=2).mean(dim=2)).sum(dim=1)
