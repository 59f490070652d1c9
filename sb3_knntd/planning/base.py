"""Interface of planners: they learn a model from transitions, and plan the values of a table with it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np

from sb3_knntd.model import Prediction

#: Values are planned for a horizon of at most this many steps.
LONGEST_HORIZON = 1000.0
#: Value iteration ends when no value changes by more than this share of the largest reward.
TOLERANCE = 1e-3


class PlanSettings(NamedTuple):
    """
    Parameters of planning.

    :param gamma: γ, in [0, 1]
    :param optimism: how much better than all seen what is not known may be, in ranges of the reward
    :param simulated_steps: number of simulated steps for each step of the environment
    :param learning_rate: α of simulated steps
    :param trace_decay: λ of simulated steps
    """

    gamma: float
    optimism: float
    simulated_steps: int
    learning_rate: float
    trace_decay: float

    @property
    def horizon(self) -> float:
        """The sum of the discounts, 1 / (1 - γ), at most 1000."""
        return min(1.0 / max(1.0 - self.gamma, 1e-9), LONGEST_HORIZON)


class RewardRange:
    """The range of the rewards seen so far, and what follows from it for values."""

    def __init__(self) -> None:
        #: lowest and highest reward of a step that did not end its episode, then of one that did
        self.numbers = np.array([np.inf, -np.inf, np.inf, -np.inf])

    def add(self, reward: float, terminated: bool) -> None:
        """
        :param reward: of a step
        :param terminated: whether the next state is terminal
        """
        low = 2 if terminated else 0
        self.numbers[low] = min(self.numbers[low], reward)
        self.numbers[low + 1] = max(self.numbers[low + 1], reward)

    @property
    def differs(self) -> bool:
        """Whether there is something to choose between: rewards differ, or a step ended an episode."""
        return bool(self.numbers[0] < self.numbers[1] or self.numbers[3] > -np.inf)

    @property
    def largest(self) -> float:
        """The largest absolute reward, at least a tiny number."""
        finite = self.numbers[np.isfinite(self.numbers)]
        return max(float(np.abs(finite).max(initial=0.0)), 1e-9)

    def limits(self, horizon: float) -> tuple[float, float]:
        """
        :param horizon: sum of the discounts
        :return: limits between which all values lie
        """
        finite = self.numbers[np.isfinite(self.numbers)]
        low, high = float(finite.min(initial=0.0)), float(finite.max(initial=0.0))
        return min(low, low * horizon), max(high, high * horizon)

    def optimistic_value(self, horizon: float, optimism: float) -> float:
        """
        A value of what is not known that makes it worth a visit (R-max, Brafman and Tennenholtz, 2002).

        What is not known can be an end, or go on at the best reward. Where every step costs, an end is the better one.
        The range of the rewards of a step tells how much more there could be: it makes a difference where all that is
        known is as good as standing still.

        :param horizon: sum of the discounts
        :param optimism: how much better than all seen it may be, in ranges of the reward
        :return: the value
        """
        low, high, _, highest_end = self.numbers
        if high == -np.inf:
            return float(highest_end)
        return float(max(highest_end, high, high * horizon) + optimism * (high - low) * horizon)


class Planner(ABC):
    """
    Learns a model of the environment and plans the values of a policy's table with it.

    :param settings: parameters of planning
    """

    def __init__(self, settings: PlanSettings) -> None:
        self.settings = settings
        self.rewards = RewardRange()

    #: values by which an agent explores, of each point and action, shape (n_points, n_actions); none before the first
    #: plan
    optimistic: np.ndarray

    @abstractmethod
    def begin(self, observation: np.ndarray) -> None:
        """
        :param observation: the first one of an episode, shape (obs_dim,), observation units
        """

    @abstractmethod
    def add(
        self, observation: np.ndarray, action: np.ndarray, reward: float, next_observation: np.ndarray, terminated: bool
    ) -> None:
        """
        Learn from a transition.

        :param observation: shape (obs_dim,), observation units
        :param action: of a Box from -1 to 1 in each dimension, shape (action_dim,); Discrete: the column, shape (1,)
        :param reward: reward of the step
        :param next_observation: shape (obs_dim,), observation units; the last one where the episode ended
        :param terminated: whether the next state is terminal
        """

    @abstractmethod
    def plan(self, n_steps: int, seed: int) -> None:
        """
        Plan with what has been learned, and write the values into the table.

        :param n_steps: number of steps of the environment since the last plan
        :param seed: of the random numbers, from 0 to 2⁵³ - 1
        """

    @abstractmethod
    def predict(self, observation: np.ndarray, action: np.ndarray) -> Prediction:
        """
        :param observation: shape (obs_dim,), observation units
        :param action: of a Box from -1 to 1 in each dimension, shape (action_dim,); Discrete: the column, shape (1,)
        :return: what is expected after the step
        """

    @property
    @abstractmethod
    def n_transitions(self) -> int:
        """Number of transitions that the model remembers."""

    @property
    @abstractmethod
    def visited(self) -> np.ndarray:
        """The observations that the remembered transitions began at, shape (n, obs_dim), observation units."""

    @property
    @abstractmethod
    def known(self) -> np.ndarray:
        """Whether an action is known at a point, shape (n_points, n_actions), bool."""

    @property
    def error_share(self) -> float:
        """How far the remembered steps are from the model, as a share of the changes in them; 0 if it counts them."""
        return 0.0

    @abstractmethod
    def summary(self) -> dict[str, float]:
        """
        :return: figures for the log, on what happened since the last call
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """
        :return: tensors and numbers
        """

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Restore a state. The policy must have been restored before.

        :param state: the return value of :meth:`state_dict`
        :raises ValueError: if it is invalid; the message says why
        """
