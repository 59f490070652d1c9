"""Interface of learners: a learning step in all environments, and updates from given transitions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.actions.selection import ActionSelector
from sb3_knntd.common.checks import check_number
from sb3_knntd.common.state_checks import checked_integer, checked_points, checked_tensor, entry
from sb3_knntd.kernels.selection import UNDRAWN
from sb3_knntd.kernels.state import UpdateConfig
from sb3_knntd.kernels.traces import LARGEST_VALUE, LEAST_CLOCK
from sb3_knntd.learners.growth import grow, lay_anew
from sb3_knntd.perception import Experience, GrowingPoints, Perceiver
from sb3_knntd.q_table import QTable
from sb3_knntd.q_table.active_traces import SMALLEST_CAPACITY

#: Tolerance for sums of numbers from a file.
ROUNDING = 1e-6

DIVERGENCE = (
    f"action values would exceed {LARGEST_VALUE:g} in size: they diverge. Lower learning_rate, or trace_decay, or use "
    "step_size='normalized' and gamma < 1"
)


#: The scheduled parameters at one step: α, at least 0; λ, in [0, 1]; and ε, in [0, 1], or the temperature, above 0.
#: A plain tuple, since one is made at every step.
Rates = tuple[float, float, float]


def check_rates(rates: Rates, selector: ActionSelector) -> None:
    """
    :param rates: the scheduled parameters at one step
    :param selector: tells whether the last of them is ε or a temperature
    :raises ValueError: if a rate is out of range; the message names it
    """
    learning_rate, trace_decay, exploration = rates
    check_number("learning_rate at this step", learning_rate, 0.0)
    check_number("trace_decay at this step", trace_decay, 0.0, 1.0)
    if selector.rate_is_temperature:
        check_number("temperature at this step", exploration, 0.0, above=True)
    else:
        check_number("the exploration rate at this step", exploration, 0.0, 1.0)


def update_rates(learning_rate: float, trace_decay: float) -> Rates:
    """
    :param learning_rate: α, at least 0
    :param trace_decay: λ, in [0, 1]
    :return: the rates of an update, without exploration
    :raises ValueError: if one is out of range
    """
    learning_rate = check_number("learning_rate", learning_rate, 0.0)
    return learning_rate, check_number("trace_decay", trace_decay, 0.0, 1.0), 0.0


class Transitions(NamedTuple):
    """
    Transitions to learn from, in temporal order.

    :param observations: shape (n, *obs_shape), observation units
    :param actions: indices of actions, counted from 0, shape (n,); or vectors, shape (n, action_dim)
    :param rewards: shape (n,)
    :param next_observations: observations after the steps, before a reset, shape (n, *obs_shape), observation units
    :param terminated: whether the next state is terminal, with value 0, shape (n,), bool
    :param ended: whether the next transition does not continue this one: at the end of an episode, at a truncation, or
        everywhere for single steps, shape (n,), bool
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    terminated: np.ndarray
    ended: np.ndarray

    def columns(self, selector: ActionSelector, obs_dim: int) -> np.ndarray:
        """
        :param selector: maps actions to columns of the table
        :param obs_dim: number of dimensions of an observation
        :return: the columns of the actions, one for each factor, shape (n, n_factors), int64
        :raises ValueError: if the length or shape of an array does not fit, or a value is not finite
        """
        n = len(self.rewards)
        sizes = {"observations": obs_dim, "next_observations": obs_dim, "rewards": 1, "terminated": 1, "ended": 1}
        for name, size in sizes.items():
            array = np.asarray(getattr(self, name))
            if len(array) != n or array.size != n * size:
                raise ValueError(f"{name} must have {n} rows of {size} numbers; got shape {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite; got {array[~np.isfinite(array)][0]} in them")
        columns = selector.columns_of(self.actions)
        if len(columns) != n:
            raise ValueError(f"actions must have {n} rows; got {len(columns)}")
        return columns


class Learner(ABC):
    """
    Algorithms 1 to 3 of the paper, for several synchronous environments. Between calls it stores the state of each
    episode: the perception and the selected action at the current observation, and the traces.

    :param perceiver: finds and weighs the neighbours of an observation
    :param table: the Q-table
    :param selector: selects actions
    :param n_envs: number of environments
    :param config: variant of the update
    :param experience: where each step is recorded
    """

    #: whether the state of the episodes is known; if not, call :meth:`begin`
    in_episodes = False
    #: version of the rules that the current actions obey
    rules_version = 0

    def __init__(
        self,
        perceiver: Perceiver,
        table: QTable,
        selector: ActionSelector,
        n_envs: int,
        config: UpdateConfig,
        experience: Experience,
    ) -> None:
        self.perceiver = perceiver
        self.table = table
        self.selector = selector
        self.n_envs = n_envs
        self.config = config
        self.experience = experience
        #: number of environments, neighbours, and action factors
        self.shape = n_envs, perceiver.search.n_neighbors, selector.n_factors

    @property
    @abstractmethod
    def actions(self) -> np.ndarray:
        """
        The action to take in each environment: its index, shape (n_envs,), int64, or a vector, shape (n_envs,
        action_dim). The array is valid until the next call of :meth:`begin` or :meth:`step`.
        """

    @abstractmethod
    def begin(self, observations: np.ndarray, exploration_rate: float) -> None:
        """
        Start an episode in every environment, and select the first actions.

        :param observations: shape (n_envs, *obs_shape)
        :param exploration_rate: ε or the temperature
        :raises ValueError: if an observation is not finite
        """

    @abstractmethod
    def step(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        ended: np.ndarray,
        truncated: Mapping[int, np.ndarray],
        rates: Rates,
    ) -> None:
        """
        Learn from the transitions of the last actions, and select the next actions.

        :param observations: the current observations (after a reset where an episode ended), shape (n_envs, *obs_shape)
        :param rewards: shape (n_envs,)
        :param ended: whether the episode ended, shape (n_envs,), bool
        :param truncated: the last observation before the reset, shape obs_shape, of each environment whose episode was
            truncated
        :param rates: the scheduled parameters
        :raises ValueError: if an observation or reward is not finite, or a rate is out of range; the table is unchanged
        :raises FloatingPointError: if values would diverge; the table is unchanged
        """

    @abstractmethod
    def update(self, transitions: Transitions, learning_rate: float, trace_decay: float) -> None:
        """
        Learn off-policy from given transitions, one after the other. The traces of the current episodes are not
        affected, unless points that grow are laid anew.

        The target is r + γ max Q(s', ·), for Ex⟨a⟩ r + γ Σ p(i) max Q(i, ·). Traces are cut as in Watkins's Q(λ):
        before an action whose value is lower than that of the greedy one, and where an episode ends (Watkins 1989;
        Sutton and Barto, 2nd ed., section 12.10). A continuous action is replaced by the nearest action point.

        :param transitions: the transitions
        :param learning_rate: α, at least 0
        :param trace_decay: λ, in [0, 1]
        :raises ValueError: if an argument is invalid or not finite; nothing has been learned
        :raises FloatingPointError: if values would diverge; all transitions before have been learned from
        """

    def _grow(self, observations: np.ndarray, truncated: Mapping[int, np.ndarray]) -> None:
        """Make points of the current observations, and then of those before a truncation, see :func:`grow`."""
        seen = np.concatenate((observations, list(truncated.values()))) if truncated else observations
        grow(self.perceiver, self.table, seen)

    def grow_for(self, transitions: Transitions) -> None:
        """
        Make points of given observations as if they had been visited, if the points grow.

        :param transitions: the transitions
        """
        points = self.perceiver.points
        if not isinstance(points, GrowingPoints):
            return
        seen, after, terminated = map(np.asarray, (transitions[0], transitions[3], transitions[4]))
        seen = np.concatenate((seen, after[~terminated.astype(bool)]))
        # Each time that the points are laid anew there is room for at least one more, at a larger spacing.
        while not self.perceiver.sees(seen):
            if lay_anew(self.perceiver, self.table, seen) is not None:
                self.abandon_episodes()
            grow(self.perceiver, self.table, seen)
        grow(self.perceiver, self.table, seen)

    def _record(self, transitions: Transitions, n: int) -> None:
        """Record the first ``n`` transitions."""
        rows = [th.as_tensor(np.asarray(array)[:n]) for array in transitions]
        before, after = (array.reshape(n, self.perceiver.bounds.obs_dim) for array in (rows[0], rows[3]))
        # Both observations of a given transition belong to it, also at the end of an episode.
        self.experience.record(before, after, rows[2].reshape(n), th.zeros(n, dtype=th.bool), self.perceiver.bounds)

    def configure(self, selector: ActionSelector, config: UpdateConfig) -> None:
        """
        Change parameters within the current episodes.

        :param selector: selects actions; it must use the same number of random numbers as before
        :param config: variant of the update
        """
        self.selector = selector
        self.config = config

    def abandon_episodes(self) -> None:
        """Forget the current episodes: their next step is not learned from."""
        self.in_episodes = False

    @property
    @abstractmethod
    def n_traced(self) -> int:
        """Number of points that have a trace."""

    @abstractmethod
    def summary(self) -> dict[str, float]:
        """
        :return: ``td_error``, the mean absolute TD error, and ``q_mean``, the mean value Q(s, a) of the updated states
            and actions, both since the last call; empty if there were no updates
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """
        :return: tensors and numbers; the same keys for every learner
        """

    def load_state_dict(self, state_dict: dict[str, Any], strict: bool = True) -> None:
        """
        Restore the state of a learner of the same table. A state of another number of environments or neighbours is
        ignored.

        :param state_dict: the return value of :meth:`state_dict`
        :param strict: has no effect, part of torch's signature
        :raises ValueError: if the state is invalid; the message says why
        """
        in_episodes = getattr(entry(state_dict, "entries"), "shape", None) == self.shape
        if in_episodes:
            probabilities = checked_tensor(state_dict, "probabilities", self.shape[:2], th.float64, 0.0, 1.0 + ROUNDING)
            # All zeros if it was saved outside of episodes. Then the rest is not used, and may be of dropped points.
            in_episodes = bool(probabilities.any())
        if in_episodes:
            # Files of versions without rules do not have it.
            state_dict = {"forbidden": th.zeros(self.n_envs, self.table.n_actions, dtype=th.bool), **state_dict}
            self._check_state(state_dict)
        self._forget()
        self.in_episodes = in_episodes
        if in_episodes:
            self.rules_version = self.selector.rules.version
            self._take_over(state_dict)

    def _observations_in(self, state_dict: dict[str, Any]) -> th.Tensor:
        """The current observations, shape (n_envs, obs_dim); infinite in a state that was saved without them."""
        unknown = th.full((self.n_envs, self.perceiver.bounds.obs_dim), th.inf, dtype=th.float64)
        observations: th.Tensor = state_dict.get("observations", unknown)
        return observations

    @abstractmethod
    def _forget(self) -> None:
        """Drop all traces and the values of the entries with a trace."""

    @abstractmethod
    def _take_over(self, state_dict: dict[str, Any]) -> None:
        """Restore a valid state."""

    def _check_state(self, state: dict[str, Any]) -> None:
        n_envs, k, n_factors = self.shape
        # Fewer than k points are followed by free rows.
        n_points, n_actions = max(self.perceiver.points.n_points, k), self.table.n_actions
        checked_tensor(state, "indices", (n_envs, k), th.int64, 0, n_points - 1)
        probabilities = state["probabilities"]
        if not ((probabilities.sum(dim=1) - 1.0).abs() <= ROUNDING).all():
            raise ValueError(f"probabilities must sum to 1 in every row; got {probabilities.sum(dim=1).tolist()}")
        checked_tensor(state, "entries", (n_envs, k, n_factors), th.int64, 0, n_actions - 1)
        checked_tensor(state, "held", (n_envs, n_factors), th.int64, UNDRAWN, n_actions - 1)
        checked_tensor(state, "lengths", (1 + n_envs,), th.float64, 0.0)
        if "observations" in state:
            shape = n_envs, self.perceiver.bounds.obs_dim
            checked_tensor(state, "observations", shape, th.float64, finite=False)
        checked_tensor(state, "forbidden", (n_envs, n_actions), th.bool)
        traces, rows = entry(state, "traces"), self.table.points()
        active = checked_points(traces, "points", n_points)
        if rows is not None and not th.isin(active, rows).all():
            raise ValueError("points must be those that the table has rows for; some have a trace and no row")
        n = len(active)
        checked_tensor(traces, "traces", (n, n_actions, n_envs), th.float64, 0.0)
        checked_tensor(traces, "share", (n, n_actions), th.float64, 0.0, 1.0 + ROUNDING)
        checked_tensor(traces, "base", (n, n_actions), th.float64)
        clock = checked_tensor(traces, "pace", (1 + n_envs,), th.float64)
        if not LEAST_CLOCK <= clock[0] <= 1.0:
            raise ValueError(f"pace must begin with a number within [{LEAST_CLOCK:g}, 1]; got {clock[0]:g}")
        # ActiveTraces.reserve never allocates more than this.
        most = 4 * (n_points if rows is None else len(rows)) + 2 * n_envs * k
        checked_integer(traces, "capacity", n, max(most, SMALLEST_CAPACITY))
