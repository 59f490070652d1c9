"""What the filter learns: how the state changes, by state and action."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_knntd.actions.columns import make_action_columns
from sb3_knntd.common.checks import (
    check_flag,
    check_integer,
    check_number,
    check_numbers,
    check_schedule,
    check_size,
    check_word,
    shown,
)
from sb3_knntd.common.schedules import progress_remaining
from sb3_knntd.common.state_checks import checked_integer, checked_points, checked_tensor
from sb3_knntd.kernels.filter import ADAPTIVE, COUNT, FIXED, OF_UPDATE
from sb3_knntd.perception import Perceiver, make_bounds, make_points, make_weights
from sb3_knntd.perception.bounds import steps_to_measure
from sb3_knntd.perception.points import AUTO_POINTS_PER_DIMENSION, count_neighbors
from sb3_knntd.perception.search import make_search

#: ``points="auto"``: a lattice of about this many points, fewer than a learner's: each entry has to average noise.
AUTO_POINTS = 2000


class Arguments(NamedTuple):
    """The parameters of :class:`~sb3_knntd.DeltaFilter`, as they were given."""

    learning_rate: float | str | Callable[[float], float]
    update: str | None
    reference: str
    gain: Any
    warmup: float
    n_neighbors: int | str
    points: Any
    bounds: Any
    weights: str | Callable[[th.Tensor], Any]
    bandwidth: float
    search: str
    action_points: Any
    total_timesteps: int | None
    compiled: bool


class DeltaTable:
    """
    The expected change δ(i, a) of the state at each point for each action (eq. 28), how often each entry was visited,
    and what the innovations were like.

    :param observation_space: Box of shape (obs_dim,)
    :param action_space: Discrete, or Box with finite bounds
    :param arguments: see :class:`~sb3_knntd.DeltaFilter`
    :param bounds_from_space: whether the observation space tells the range of the observations
    :raises ValueError: if an argument or a space does not fit; the message says which, and what would
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        arguments: Arguments,
        bounds_from_space: bool = True,
    ) -> None:
        box = _check_observation_space(observation_space)
        self.observation_space = box
        self.action_space = action_space
        self.arguments = arguments
        self.bounds_from_space = bounds_from_space
        self.obs_dim = box.shape[0]
        self._check_arguments()

        #: action points in shares of the space's width, for Box actions
        self._action_points, self._action_width = np.empty((0, 0)), np.empty(0)
        if isinstance(action_space, spaces.Discrete):
            n_columns = int(action_space.n)
        elif isinstance(action_space, spaces.Box):
            points = make_action_columns(action_space, arguments.action_points, "joint").points
            width = action_space.high.astype(np.float64) - action_space.low
            # A dimension that is fixed has all its points in one place.
            self._action_width = np.where(width > 0, width, 1.0).reshape(-1)
            self._action_points = points / self._action_width
            n_columns = len(points)
        else:
            raise ValueError(
                f"the action space must be Discrete or Box; got {action_space}. MultiDiscrete and MultiBinary can be "
                "numbered into one Discrete space by a gymnasium.ActionWrapper"
            )

        per_dimension = min(AUTO_POINTS_PER_DIMENSION, max(2, round(AUTO_POINTS ** (1 / self.obs_dim))))
        is_auto = isinstance(arguments.points, str) and arguments.points == "auto"
        places = make_points(per_dimension if is_auto else arguments.points, box)
        n_neighbors = count_neighbors(arguments.n_neighbors, box, places.n_points, self.obs_dim)
        self.perceiver = Perceiver(
            make_bounds(arguments.bounds, box, from_space=bounds_from_space),
            places,
            make_search(arguments.search, places, n_neighbors),
            make_weights(arguments.weights, arguments.bandwidth, n_neighbors),
        )
        check_size(
            f"points: a table of {places.n_points:,} points and {n_columns:,} actions",
            places.n_points * n_columns * (self.obs_dim + 1) * 8,
            "give fewer points, 1 for dimensions that the changes do not depend on, or fewer action_points",
        )
        #: expected changes, shape (n_points, n_columns, obs_dim), observation units
        self.deltas = np.zeros((places.n_points, n_columns, self.obs_dim))
        #: visits, each shared among the neighbours as they count, shape (n_points, n_columns)
        self.visits = np.zeros((places.n_points, n_columns))
        #: what the adapted gain settles at, shape (obs_dim,). 1 until noise shows: observations pass as they are
        self.gains = np.ones(self.obs_dim)
        self.variances = np.zeros(self.obs_dim)
        self.counts = np.zeros(1)
        self.n_measured = 0
        self.n_steps = 0
        # Asking the bounds takes as long as the rest of a step.
        self._is_open = self.perceiver.bounds.is_open

    def _check_arguments(self) -> None:
        given = self.arguments
        counts = isinstance(given.learning_rate, str)
        if isinstance(given.learning_rate, str):
            check_word("learning_rate, if it is no number and no schedule,", given.learning_rate, ["count"])
        else:
            check_schedule("learning_rate", given.learning_rate, 0.0, 1.0)
        if callable(given.learning_rate) and given.total_timesteps is None:
            raise ValueError(
                "total_timesteps must be given with a learning_rate that is a schedule: a wrapper does not know how "
                "long training goes on"
            )
        if given.total_timesteps is not None:
            check_integer("total_timesteps", given.total_timesteps, 1)
        check_word("reference", given.reference, ["filtered", "observed"])
        if given.update is not None:
            check_word("update", given.update, ["averaging", "gradient"])
        check_number("warmup", given.warmup, 0.0)
        check_flag("compiled", given.compiled)
        self.averaging = counts if given.update is None else given.update == "averaging"

        self.gain, self.fixed_gain = OF_UPDATE, np.zeros(self.obs_dim)
        if isinstance(given.gain, str):
            check_word("gain, if it is no number,", given.gain, ["adaptive"])
            if given.reference == "observed":
                raise ValueError(
                    "gain='adaptive' needs reference='filtered': innovations tell of the gain only where they start "
                    "from the last estimate. With reference='observed' give None, or a number in (0, 1]"
                )
            self.gain = ADAPTIVE
        elif given.gain is not None:
            self.gain, self.fixed_gain = FIXED, self._check_gain(given.gain)
        elif counts and given.reference == "filtered":
            raise ValueError(
                "gain=None lets the update of the table alone bring the estimate back to what is observed, which "
                "learning_rate='count' makes ever weaker: give gain='adaptive', a number in (0, 1], or a learning_rate "
                "that is a number"
            )

    def _check_gain(self, gain: Any) -> np.ndarray:
        try:
            array = check_numbers("gain", gain)
        except ValueError:
            array = np.empty(0)
        if array.shape not in ((), (self.obs_dim,)) or not np.all((array > 0) & (array <= 1)):
            raise ValueError(
                f"gain must be 'adaptive', None, a number in (0, 1], or one for each of the {self.obs_dim} observation "
                f"dimensions; got {shown(gain)}"
            )
        return np.broadcast_to(array, (self.obs_dim,)).copy()

    def check_spaces(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        """
        :param observation_space: of an environment to be filtered
        :param action_space: likewise
        :raises ValueError: if they are not those that the filter was made for
        """
        for name, own, given in (
            ("observation", self.observation_space, observation_space),
            ("action", self.action_space, action_space),
        ):
            if own != given:
                raise ValueError(
                    f"the filter is for the {name} space {own}, but the environment has {given}: a filter fits "
                    "environments with the spaces that it was learned on"
                )

    def columns(self, actions: Any) -> np.ndarray:
        """
        :param actions: actions of the environments, shape (n_envs, *action_shape)
        :return: the columns that stand for them, the nearest action points for Box actions, shape (n_envs,), int64
        :raises ValueError: if an action is not in the space
        """
        space = self.action_space
        actions = np.asarray(actions)
        if isinstance(space, spaces.Discrete):
            columns: np.ndarray = actions.reshape(-1).astype(np.int64) - int(space.start)
            if not all(0 <= column < space.n for column in columns.tolist()):
                raise ValueError(f"actions must be in {space}; got {actions.tolist()}")
            return columns
        places = actions.reshape(len(actions), -1) / self._action_width
        if not np.isfinite(places).all():
            raise ValueError(f"actions must be finite; got {actions.tolist()}")
        nearest: np.ndarray = np.square(places[:, None] - self._action_points).sum(axis=2).argmin(axis=1)
        return nearest

    def rate(self) -> float:
        """
        :return: α now, or ``COUNT``
        """
        rate = self.arguments.learning_rate
        if isinstance(rate, str):
            return COUNT
        if not callable(rate):
            return float(rate)
        assert self.arguments.total_timesteps is not None
        return float(rate(progress_remaining(self.n_steps, self.arguments.total_timesteps)))

    def must_measure(self, n_envs: int) -> bool:
        """
        :param n_envs: number of environments
        :return: whether the range of some dimension is still to be found
        """
        return self._is_open and self.n_measured < steps_to_measure(n_envs)

    def measure(self, observations: np.ndarray) -> None:
        """
        :param observations: shape (n_envs, obs_dim), finite; they widen the range of the open dimensions
        """
        self.perceiver.measure(th.from_numpy(observations))
        self.n_measured += len(observations)

    def follow(self, estimates: np.ndarray) -> None:
        """
        Widen adaptive bounds where estimates lie beyond them. Where points move, each is given what was
        there.

        :param estimates: shape (n_envs, obs_dim)
        """
        if not self.perceiver.bounds.adaptive or self.perceiver.sees(estimates):
            return
        regridding = self.perceiver.widen(th.from_numpy(estimates))
        if regridding is not None:
            around, shares = regridding.sources(th.arange(self.perceiver.points.n_points))
            for array in (self.deltas, self.visits):
                array[:] = np.einsum("ik,ik...->i...", shares.numpy(), array[around.numpy()])

    def state_dict(self) -> dict[str, Any]:
        """
        :return: all that was learned, as tensors and numbers; of the table the rows that were visited
        """
        visited = np.flatnonzero(self.visits.any(axis=1))
        arrays = {
            "points": visited,
            "deltas": self.deltas[visited],
            "visits": self.visits[visited],
            "gains": self.gains.copy(),
            "variances": self.variances.copy(),
            "counts": self.counts.copy(),
        }
        return {
            **{name: th.from_numpy(array) for name, array in arrays.items()},
            "bounds": self.perceiver.bounds.state_dict(),
            "n_measured": self.n_measured,
            "n_steps": self.n_steps,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """
        :param state_dict: of a table with the same spaces and arguments
        :raises ValueError: if no such table can have returned it
        """
        points = checked_points(state_dict, "points", len(self.deltas))
        shape = (len(points), *self.visits.shape[1:])
        checked_tensor(state_dict, "deltas", (*shape, self.obs_dim), th.float64)
        checked_tensor(state_dict, "visits", shape, th.float64, 0.0)
        checked_tensor(state_dict, "gains", (self.obs_dim,), th.float64, 0.0, 1.0)
        checked_tensor(state_dict, "variances", (self.obs_dim,), th.float64)
        checked_tensor(state_dict, "counts", (1,), th.float64, 0.0)
        for name in ("n_measured", "n_steps"):
            checked_integer(state_dict, name, 0, 2**62)
        visited = points.numpy()
        self.deltas[:], self.visits[:] = 0.0, 0.0
        self.deltas[visited], self.visits[visited] = state_dict["deltas"].numpy(), state_dict["visits"].numpy()
        for name in ("gains", "variances", "counts"):
            getattr(self, name)[:] = state_dict[name].numpy()
        self.perceiver.bounds.load_state_dict(state_dict["bounds"])
        self.perceiver.fit()
        self.n_measured, self.n_steps = state_dict["n_measured"], state_dict["n_steps"]

    def __getstate__(self) -> dict[str, Any]:
        made_from = (self.observation_space, self.action_space, self.arguments, self.bounds_from_space)
        return {"made_from": made_from, "state": self.state_dict()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(*state["made_from"])  # type: ignore[misc]
        self.load_state_dict(state["state"])


def _check_observation_space(space: spaces.Space[Any]) -> spaces.Box:
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.shape != (0,):
        if np.issubdtype(space.dtype, np.floating):
            return space
        advice = "A state estimate is no whole number: make them float32 with gymnasium.wrappers.DtypeObservation"
    elif isinstance(space, spaces.Box | spaces.Dict | spaces.Tuple):
        advice = "Flatten it with gymnasium.wrappers.FlattenObservation"
    else:
        advice = "Its observations have no differences that could be learned"
    raise ValueError(f"the filter takes observations in a Box of shape (n,) and floating type; got {space}. {advice}")
