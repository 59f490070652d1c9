"""The policies: perception, Q-table and action selection."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Protocol

import cloudpickle
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd.actions.columns import ActionColumns, discrete_columns, make_action_columns
from sb3_knntd.actions.exploration import EpsilonGreedy
from sb3_knntd.actions.rules import Rules
from sb3_knntd.actions.selection import ActionSelector, MeanActionSelector, MeanValueSelector, mean_rows
from sb3_knntd.common.checks import check_flag, check_number, check_path, check_size, check_word, shown
from sb3_knntd.common.interrupts import interrupts_held
from sb3_knntd.common.plain import loaded_class
from sb3_knntd.common.tracing import is_traced
from sb3_knntd.editing import TableEditing
from sb3_knntd.export import FrozenPolicy, export_policy
from sb3_knntd.export.shared import read_safetensors
from sb3_knntd.kernels import jit
from sb3_knntd.kernels.selection import Exploration, Target
from sb3_knntd.kernels.traces import LARGEST_VALUE
from sb3_knntd.learners.compiled import GreedyReader
from sb3_knntd.learners.growth import grow, lay_anew
from sb3_knntd.perception import (
    Experience,
    GrowingPoints,
    Growth,
    Lattice,
    Perception,
    PerceptionConfig,
    Points,
    Scattered,
    make_perceiver,
)
from sb3_knntd.perception.search import SEARCHES
from sb3_knntd.perception.weights import KernelWeights
from sb3_knntd.q_table import DenseTable, GrowingTable, HashedTable, QTable

#: ``table="auto"``: maximum size of a dense table of a lattice, bytes; larger tables are hashed.
DENSE_TABLE_BYTES = 2**28


class KNNPolicy(TableEditing, BasePolicy):
    """
    A table of action values at points of the observation space, read as a weighted mean over the k nearest points.

    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :param action_space: Discrete
    :param lr_schedule: has no effect, part of SB3's signature
    :param n_neighbors: k, or ``"auto"``: 2 obs_dim + 1, a point and its neighbours along each axis; 1 for all but a Box
    :param points: ``"auto"``, ``"grow"``, an int, one int per dimension, or an array (n_points, obs_dim) in observation
        units
    :param spacing: of points that grow, see :class:`~sb3_knntd.KNNTD`
    :param max_points: of points that grow, see :class:`~sb3_knntd.KNNTD`
    :param bounds: ``None``, ``"adaptive"``, (low, high), arrays of shape (obs_dim,) in observation units, or a dict of
        dimensions and their (low, high)
    :param weights: ``"inverse_quadratic"``, ``"gaussian"`` or a function from squared distances (batch, k) to
        weights (batch, k)
    :param bandwidth: h of the weights, scaled units
    :param search: how neighbours are found, see :class:`~sb3_knntd.KNNTD`
    :param initial_value: initial value of all entries of the table
    :param dtype: floating type of the table, ``torch.float64`` or ``torch.float32``
    :param table: ``"dense"`` (a row for every point), ``"hashed"`` (a row for every visited point, for lattices larger
        than memory, on the CPU), or ``"auto"``: dense up to 256 MiB
    :param compiled: whether to use the compiled step if possible: on the CPU, with numba, and unless ``weights`` is a
        function
    :param bounds_from_space: whether the bounds of the observation space are the range of the observations
    :param columns: the actions that the columns of the table stand for; by default the Discrete actions
    :raises ValueError: if an argument is invalid; the message names it and says what is valid
    """

    #: type of the supported action spaces
    acts_in: ClassVar[type[spaces.Space[Any]]] = spaces.Discrete

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule | None = None,
        n_neighbors: int | str = "auto",
        points: Any = "auto",
        spacing: float | str = "auto",
        max_points: int = 5000,
        bounds: Any = None,
        weights: str | Callable[[th.Tensor], Any] = "inverse_quadratic",
        bandwidth: float = 1.0,
        search: str = "auto",
        initial_value: float = 0.0,
        dtype: th.dtype = th.float64,
        table: str = "auto",
        compiled: bool = True,
        bounds_from_space: bool = True,
        columns: ActionColumns | None = None,
    ) -> None:
        super().__init__(observation_space, action_space)
        initial_value = check_number("initial_value", initial_value, -LARGEST_VALUE, LARGEST_VALUE)
        if not isinstance(dtype, th.dtype) or dtype not in (th.float32, th.float64):
            raise ValueError(f"policy_kwargs: dtype must be torch.float64 or torch.float32; got {shown(dtype)}")
        compiled = check_flag("policy_kwargs: compiled", compiled)
        growth = Growth(spacing, max_points)
        grows = isinstance(points, str) and points == "grow"
        perception = PerceptionConfig(n_neighbors, growth if grows else points, bounds, weights, bandwidth, search)
        self._arguments = {
            **vars(perception),
            "points": points,
            "spacing": spacing,
            "max_points": max_points,
            "initial_value": initial_value,
            "dtype": dtype,
            "table": table,
            "compiled": compiled,
            "bounds_from_space": bounds_from_space,
        }
        self.perceiver = make_perceiver(perception, observation_space, bounds_from_space=bounds_from_space)
        self.n_neighbors = self.perceiver.search.n_neighbors
        #: statistics of the steps that were learned from
        self.experience = Experience(self.perceiver.bounds.obs_dim)
        self._compilable = compiled and jit.AVAILABLE and isinstance(self.perceiver.weights, KernelWeights)
        if compiled and not jit.AVAILABLE:
            warnings.warn(
                f"numba cannot be used ({jit.REASON}): learning uses torch operations, which is slower", stacklevel=2
            )
        #: the actions that the columns of the table stand for
        self.columns = self._default_columns() if columns is None else columns
        n_actions = int(self.columns.factors[-1])
        if grows:
            self.table: QTable = self._make_growing_table(table, n_actions, initial_value, dtype)
        else:
            self.table = self._make_table(table, self.perceiver.points, n_actions, initial_value, dtype)
        #: where actions are forbidden, see :meth:`forbid`
        self.rules = Rules(self.perceiver.bounds.obs_dim, n_actions)
        #: selects actions; the algorithm sets one that explores
        self.selector = self._greedy_selector()
        self._reader: GreedyReader | None = None
        check_size(
            f"n_neighbors: the action values of {self.n_neighbors} neighbours",
            8 * self.n_neighbors * n_actions,
            "give fewer neighbours",
        )

    def _default_columns(self) -> ActionColumns:
        assert isinstance(self.action_space, spaces.Discrete)
        # Adding an array is faster than adding a Python int.
        self._first_action = np.asarray(self.action_space.start)
        return discrete_columns(int(self.action_space.n))

    def _greedy_selector(self) -> ActionSelector:
        return MeanValueSelector(self.columns, Target.SARSA, EpsilonGreedy(), random_ties=False, rules=self.rules)

    def _make_table(self, table: str, places: Points, n_actions: int, initial_value: float, dtype: th.dtype) -> QTable:
        check_word("policy_kwargs: table", table, ["auto", "dense", "hashed"])
        row_bytes = n_actions * dtype.itemsize
        if table == "auto":
            fits = places.n_points * row_bytes <= DENSE_TABLE_BYTES
            table = "dense" if fits or not isinstance(places, Lattice) else "hashed"
        if table == "dense":
            check_size(
                f"points: a dense table of {places.n_points} points and {n_actions} actions",
                places.n_points * row_bytes,
                "give fewer points, or a lattice with policy_kwargs={'table': 'hashed'}",
            )
            return DenseTable(places.n_points, n_actions, initial_value, dtype)
        if not self._compilable:
            raise ValueError(
                f"points: a table of {places.n_points} points needs the compiled step, which works on the CPU with "
                "numba and with weights that are no function. Give fewer points, or policy_kwargs={'table': 'dense'}"
            )
        check_size(
            f"action_points, action space: the first {HashedTable.SMALLEST} rows of a table of {n_actions} actions",
            HashedTable.SMALLEST * row_bytes,
            "have fewer actions",
        )
        return HashedTable(places.n_points, n_actions, initial_value, dtype)

    def _make_growing_table(self, table: str, n_actions: int, initial_value: float, dtype: th.dtype) -> QTable:
        assert isinstance(self.perceiver.points, GrowingPoints)
        max_points = self.perceiver.points.max_points
        check_word("policy_kwargs: table of points that grow", table, ["auto", "dense"])
        check_size(
            f"max_points: a table of {max_points} points and {n_actions} actions",
            # While points are thinned out there are two.
            2 * max_points * n_actions * dtype.itemsize,
            "give fewer points",
        )
        return GrowingTable(self.n_neighbors, n_actions, initial_value, dtype)

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled step is used."""
        return self._compilable and self.device.type == "cpu"

    @property
    def device(self) -> th.device:
        """Device of the table."""
        return self.table.values.device

    @property
    def search_name(self) -> str:
        """Name of the neighbour search in use."""
        return next(name for name, kind in SEARCHES.items() if type(self.perceiver.search) is kind)

    @property
    def points(self) -> th.Tensor:
        """
        The perception points, shape (n_points, obs_dim), observation units; with a hashed table, only the visited
        ones. The range of unbounded dimensions is [-1, 1] until ``learn`` has measured it.
        """
        bounds, points = self.perceiver.bounds, self.perceiver.points
        if isinstance(points, Scattered):
            return points.places.clone()
        return bounds.unscale(points.coordinates(bounds, self.table.points()))

    @property
    def q_table(self) -> th.Tensor:
        """
        The action values at :attr:`points`, shape (n_points, n_actions). To set values during training, use
        ``set_parameters``.
        """
        return self.table.entries()

    @property
    def visits(self) -> th.Tensor:
        """
        The number of learning steps that have updated each of :attr:`points` as one of the k nearest, up to 2³⁰, shape
        (n_points,), int32. Updates along the traces are not counted.
        """
        return self.table.counts()

    def widen(self, observations: th.Tensor) -> None:
        """
        Widen adaptive bounds to include these observations. If points move, each is set to the values that the table
        had at its new position; the learner must then start new episodes.

        :param observations: shape (batch, *obs_shape), any number type, observation units
        """
        before = {name: value.clone() for name, value in self.perceiver.bounds.state_dict().items()}
        with self.table.lock, interrupts_held():
            try:
                regridding = self.perceiver.widen(observations)
                if regridding is not None:
                    self.table.carry_over(regridding)
            except BaseException:
                self.perceiver.bounds.load_state_dict(before)
                self.perceiver.fit()
                raise

    def add_points(self, points: np.ndarray | th.Tensor) -> None:
        """
        Add scattered points. Each is set to the values that the table has at its position. All others keep their values
        and traces.

        :param points: shape (n_new, obs_dim), observation units
        :raises ValueError: if the points of the policy are a lattice, or the new ones are invalid
        """
        values = self.q_values(points)
        with self.table.lock, interrupts_held():
            self.perceiver.add_points(points)
            self.table.add_rows(values)

    @property
    def grows(self) -> bool:
        """Whether visited observations become points."""
        return isinstance(self.perceiver.points, GrowingPoints)

    def grow(self, observations: np.ndarray) -> np.ndarray:
        """
        Make a point of each observation that lies farther than the spacing from all points, one after the other, as
        long as there is room: while ``perceiver.points.is_full``, call :meth:`lay_anew` first. The learner calls it for
        what it perceives. Does nothing if the points do not grow.

        A new point takes the values that were read at its place, or the initial value where that is higher. All other
        points keep their indices, values and traces.

        :param observations: shape (batch, *obs_shape), observation units, finite
        :return: the indices of the new points, shape (n,), int64
        """
        return grow(self.perceiver, self.table, observations)

    def lay_anew(self, observations: np.ndarray) -> np.ndarray | None:
        """
        Lay points that grow anew: scale the open dimensions by the range visited so far, these observations included;
        drop points that have come nearer than the spacing to another; and, if there are ``max_points`` of them, let the
        spacing grow until there is room. It is due when ``perceiver.sees(observations)`` is false.

        Each remaining point takes the mean of the values of the points nearest to it that were visited. If a point was
        dropped, all traces are, and the learner must start new episodes.

        :param observations: shape (batch, *obs_shape), observation units, finite
        :return: the new index of each point, of a dropped one that of the remaining point nearest to it, shape
            (n_before,), int64; ``None`` if all points stay
        """
        return lay_anew(self.perceiver, self.table, observations)

    def perceive(self, observation: np.ndarray | th.Tensor) -> Perception:
        """
        :param observation: one observation, or a batch, observation units
        :return: the nearest points and their probabilities; one row for a single observation
        """
        return self._perceive(self._to_tensor(observation))

    def q_values(self, observation: np.ndarray | th.Tensor) -> th.Tensor:
        """
        :param observation: one observation, or a batch, observation units
        :return: Q(s, ·) = Σ p(i) Q(i, ·) (eq. 8), also of forbidden actions, shape (batch, n_actions)
        """
        perception = self.perceive(observation)
        return mean_rows(self.table.rows(perception.indices), perception.probabilities.to(self.table.values.dtype))

    def state_values(self, observation: np.ndarray | th.Tensor) -> th.Tensor:
        """
        :param observation: one observation, or a batch, observation units
        :return: the values of the greedy actions: max Q(s, ·) (eq. 12), for Ex⟨a⟩ Σ p(i) max Q(i, ·) (eq. 25), shape
            (batch,)
        """
        return self.selector.greedy_value(*self.perceived_rows(observation))

    def perceived_rows(self, observation: np.ndarray | th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param observation: one observation, or a batch, observation units
        :return: the rows of the table at the nearest points, with -inf at forbidden actions, shape
            (batch, k, n_actions), and the probabilities of the points, shape (batch, k)
        """
        return self._rows(self._to_tensor(observation))

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The greedy action, the lowest one of equal actions.

        :param observation: one observation, or a batch, observation units
        :param state: has no effect and is returned
        :param episode_start: has no effect
        :param deterministic: has no effect, the policy is deterministic
        :return: action, or a batch of actions, and ``state``
        """
        shape = self.observation_space.shape or ()
        array = observation if isinstance(observation, np.ndarray) else np.empty((0,) * (len(shape) + 2))
        batch = array.shape[: array.ndim - len(shape)]
        if not self.is_compiled or len(batch) > 1 or (*batch, *shape) != array.shape:
            actions, state = super().predict(observation, state, episode_start, deterministic)
            return actions.astype(self.action_space.dtype), state
        observations = array.reshape(-1, self.perceiver.bounds.obs_dim)
        if not np.isfinite(observations).all():
            raise ValueError(f"observation must be finite; got {observations.tolist()}")
        if self._reader is None:
            self._reader = GreedyReader(self.perceiver, self.table, self._greedy_selector())
        actions = self._recommended(*self._reader(observations))
        return actions.reshape((*batch, *(self.action_space.shape or ()))), state

    def fit_actions(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: indices of actions, counted from 0, shape (batch,)
        :return: actions of the environment, counted from the start of its action space, a new array
        """
        fitting = actions.copy()
        if self._first_action:
            fitting += self._first_action
        return fitting

    def columns_of(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: actions of the environment, shape (batch, *action_shape)
        :return: their columns of the table, one for each action factor, shape (batch, n_factors), int64
        :raises ValueError: if there is no such action
        """
        return self.selector.columns_of(np.asarray(actions) - self._first_action)

    def _recommended(self, action_indices: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
        """Actions of the environment, shape (batch, *action_shape), from the columns that the neighbours select."""
        return self.fit_actions(action_indices[:, 0, 0])

    def forward(self, observation: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """
        :param observation: shape (batch, *obs_shape)
        :param deterministic: has no effect, the policy is deterministic
        :return: actions, shape (batch, *action_shape)
        """
        return self._predict(observation, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        assert isinstance(self.action_space, spaces.Discrete)
        rows, probabilities = self._exact_rows(observation)
        return self.selector.greedy_actions(rows, probabilities) + int(self.action_space.start)

    def _to_tensor(self, observation: np.ndarray | th.Tensor) -> th.Tensor:
        array = observation.cpu().numpy() if isinstance(observation, th.Tensor) else np.asarray(observation)
        tensor, _ = self.obs_to_tensor(array)
        assert isinstance(tensor, th.Tensor)
        return tensor

    def _perceive(self, observations: th.Tensor) -> Perception:
        # Traced tensors have no values to check.
        if not is_traced() and not th.isfinite(observations).all():
            raise ValueError(f"observation must be finite; got {observations.tolist()}")
        perception: Perception = self.perceiver(observations)
        return perception

    def _rows(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        perception = self._perceive(observations)
        probabilities = perception.probabilities.to(self.table.values.dtype)
        return self.rules.mask(self.table.rows(perception.indices), probabilities, observations), probabilities

    def _exact_rows(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Like :meth:`_rows` in float64 for every dtype of the table, as in the kernels."""
        perception = self._perceive(observations)
        rows = self.table.rows(perception.indices).double()
        return self.rules.mask(rows, perception.probabilities, observations), perception.probabilities

    def _apply(self, fn: Callable[[th.Tensor], th.Tensor], recurse: bool = True) -> KNNPolicy:
        super()._apply(fn, recurse)
        self.perceiver.fit()
        return self

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        if not isinstance(state_dict, Mapping):
            raise ValueError(f"the state of a policy must be a dict of tensors; got {str(state_dict)[:100]}")
        places = state_dict.get("perceiver.points.places")
        if isinstance(places, th.Tensor) and isinstance(self.table, DenseTable):
            # Points may have been added since the policy was created.
            self.table.resize(len(places))
        answer = super().load_state_dict(state_dict, strict, assign)
        # Saved bounds may have been measured, and differ from the current ones.
        self.perceiver.fit()
        return answer

    def save(self, path: str) -> None:
        """
        Save the policy, including functions among its arguments.

        :param path: file, or file-like object
        """
        content = {"state_dict": self.state_dict(), "data": self._get_constructor_parameters()}
        th.save(content, path, pickle_module=cloudpickle)

    def frozen(self) -> FrozenPolicy:
        """
        :return: what the policy does now, as plain numbers
        """
        selector = self._greedy_selector()
        return FrozenPolicy.of(self.perceiver, self.table, selector, self.observation_space, self.action_space)

    def export(
        self, path: str | Path, format: str, *, test_vectors: str | Path | None = None, **options: Any
    ) -> list[Path]:
        """
        Write the greedy policy in a form that needs neither this package nor, but for torch's own formats, Python.

        :param path: file to write, with the format's suffix added if it has none
        :param format: ``"c"``, ``"onnx"``, ``"torchscript"``, ``"torch_export"``, ``"safetensors"``, ``"csv"`` or
            ``"npz"``, see :data:`sb3_knntd.export.FORMATS`
        :param test_vectors: a further file, CSV, for random observations with their actions and values, to test the
            exported policy with
        :param options: of the format. ``"c"`` takes ``precision``, ``"double"`` or ``"float"``, and ``rows``, the rows
            of the table to store: ``"changed"``, those that differ from the initial value, ``"all"``, or ``"auto"``
        :return: the files written
        :raises ValueError: if the format, or an option, is unknown, or the format cannot hold this policy
        :raises ImportError: if the format needs a library that is not installed
        """
        return export_policy(self, path, format, test_vectors=test_vectors, **options)

    def parameters_to_vector(self) -> np.ndarray:
        """
        :return: the entries of :attr:`q_table`, row by row, shape (n_points * n_actions,), the table's dtype
        """
        vector: np.ndarray = self.q_table.detach().cpu().numpy().flatten()
        return vector

    def load_from_vector(self, vector: np.ndarray) -> None:
        """
        Set the entries of :attr:`q_table`, also during training. The learner's traces are dropped.

        :param vector: the return value of :meth:`parameters_to_vector` of a policy with the same points
        :raises ValueError: if its length is wrong, or it is not finite
        """
        state = self.state_dict()
        values = th.as_tensor(vector, dtype=self.table.values.dtype)
        if values.shape != (self.q_table.numel(),):
            raise ValueError(
                f"vector must have shape ({self.q_table.numel()},), one number for each entry of q_table; got "
                f"{tuple(values.shape)}"
            )
        if not th.isfinite(values).all():
            raise ValueError("vector must be finite; got NaN or infinity in it")
        self.load_state_dict({**state, "table.values": values.reshape(self.q_table.shape)})

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            **self._arguments,
        }


class TableModel(Protocol):
    """A model whose policy is a table: what pictures and explanations are made from."""

    policy: KNNPolicy
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]

    def get_env(self) -> VecEnv | None:
        """The environment; ``None`` if there is none."""


class ExAPolicy(KNNPolicy):
    """
    A table of the values of action points. Each neighbour selects its best action point, and the action is their mean.

    :param observation_space: Box of shape (obs_dim,), Discrete, MultiDiscrete or MultiBinary
    :param action_space: Box with finite bounds
    :param lr_schedule: has no effect, part of SB3's signature
    :param action_points: see :class:`~sb3_knntd.ExA`
    :param action_table: see :class:`~sb3_knntd.ExA`
    :param arguments: other arguments of :class:`KNNPolicy`
    :raises ValueError: if an argument is invalid; the message names it and says what is valid
    """

    acts_in: ClassVar[type[spaces.Space[Any]]] = spaces.Box

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule | None = None,
        action_points: Any = 3,
        action_table: str | None = None,
        **arguments: Any,
    ) -> None:
        assert isinstance(action_space, spaces.Box)
        columns = make_action_columns(action_space, action_points, action_table)
        super().__init__(observation_space, action_space, lr_schedule, columns=columns, **arguments)
        self._arguments |= {"action_points": action_points, "action_table": action_table}
        self._actions_are_whole = np.issubdtype(action_space.dtype, np.integer)
        self._action_type = action_space.dtype
        # One-dimensional actions need no reshaping, and looking up their shape takes as long as converting them.
        self._action_shape = None if len(action_space.shape) == 1 else (-1, *action_space.shape)
        # Rounding can move a mean beyond its terms by a few units in the last place of a float64. In float32 it cannot.
        self._can_exceed = action_space.dtype != np.float32
        self._action_bounds = [th.from_numpy(bound) for bound in (action_space.low, action_space.high)]

    @property
    def action_points(self) -> list[th.Tensor]:
        """The action points of each dimension, action units."""
        return [th.from_numpy(points) for points in self.columns.lists]

    def fit_actions(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: shape (batch, action_dim), action units
        :return: the same in the shape and dtype of the action space, rounded within its bounds
        """
        if self._actions_are_whole:
            actions = np.rint(actions)
        fitting: np.ndarray = actions.astype(self._action_type)
        if self._action_shape:
            fitting = fitting.reshape(self._action_shape)
        if self._can_exceed:
            assert isinstance(self.action_space, spaces.Box)
            np.maximum(fitting, self.action_space.low, out=fitting)
            np.minimum(fitting, self.action_space.high, out=fitting)
        return fitting

    def columns_of(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: actions of the environment, shape (batch, *action_shape)
        :return: the columns of the nearest action points, one for each action factor, shape (batch, n_factors), int64
        :raises ValueError: if an action is not finite, or its shape is wrong
        """
        return self.selector.columns_of(np.asarray(actions).reshape(len(actions), -1))

    def _greedy_selector(self) -> ActionSelector:
        return MeanActionSelector(
            self.columns, Exploration.SHARED, 1.0, 0.0, self.n_neighbors, random_ties=False, rules=self.rules
        )

    def _recommended(self, action_indices: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
        points = self.columns.points[action_indices].sum(axis=2)
        # Summed one after the other, as in the kernels: a mean that is exactly between two whole actions can fall on
        # either side otherwise.
        return self.fit_actions((probabilities[..., None] * points).cumsum(axis=1)[:, -1])

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        rows, probabilities = self._exact_rows(observation)
        actions = self.selector.greedy_actions(rows, probabilities)
        # Like fit_actions, but with torch operations that can be traced.
        if self._actions_are_whole:
            actions = actions.round()
        low, high = (bound.to(actions.device) for bound in self._action_bounds)
        fitting = actions.to(low.dtype).reshape(-1, *low.shape)
        return th.minimum(th.maximum(fitting, low), high) if self._can_exceed else fitting


def load_policy(path: str | Path, device: th.device | str = "cpu") -> KNNPolicy:
    """
    Read a policy that was exported as ``"safetensors"``. Nothing from the file is executed or imported, so it may come
    from anyone.

    :param path: the file
    :param device: device of the perception and the table
    :return: the policy, to predict with and to look into. To learn on from it, make a model with the same points, and
        call ``model.policy.load_state_dict(policy.state_dict())``
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, or holds no policy of this package
    :raises ImportError: if safetensors is not installed
    """
    name, arguments, tensors = read_safetensors(check_path("path", path))
    kind = loaded_class(name, KNNPolicy)
    if any(callable(value) for value in arguments.values()):
        raise ValueError(f"{path}: an argument of the policy is a class, which nothing but a number or a word can be")
    try:
        policy: KNNPolicy = kind(**arguments)
        policy.load_state_dict(tensors)
    except (TypeError, AssertionError, AttributeError, RuntimeError) as error:
        raise ValueError(f"{path} holds no valid policy: {error}") from error
    policy.set_training_mode(False)
    return policy.to(device)
