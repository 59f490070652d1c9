"""What a user changes in a policy: values, a controller to start from, and where actions are forbidden."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_knntd.actions.columns import ActionColumns
from sb3_knntd.actions.rules import Rules
from sb3_knntd.actions.selection import mean_rows
from sb3_knntd.common.checks import check_number, check_numbers, check_size, shown
from sb3_knntd.kernels.traces import LARGEST_VALUE
from sb3_knntd.perception import Lattice, Perceiver, Perception
from sb3_knntd.perception.bounds import check_box
from sb3_knntd.q_table import DenseTable, QTable
from sb3_knntd.q_table.table import BATCH

#: Number of places around a point at which a controller is asked.
SAMPLES = 32
#: ``margin=None``: share of the range of the table's values.
MARGIN_SHARE = 0.3


class TableEditing:
    """Methods of a policy that change its table by hand."""

    if TYPE_CHECKING:
        observation_space: spaces.Space[Any]
        action_space: spaces.Space[Any]
        perceiver: Perceiver
        table: QTable
        columns: ActionColumns
        rules: Rules

        def perceive(self, observation: np.ndarray | th.Tensor) -> Perception: ...
        def columns_of(self, actions: np.ndarray) -> np.ndarray: ...

    def set_q(self, observation: np.ndarray, action: Any, value: Any) -> None:
        """
        Set the values of actions in states. The entries of the neighbours change as little as possible (least squares);
        if there are more states than entries, or the values contradict each other, so does what remains.

        :param observation: one observation, or a batch, observation units
        :param action: an action of the environment, or one for each observation
        :param value: a value, or one for each observation, up to ±1e30
        :raises ValueError: if an argument is invalid; nothing has been changed
        """
        from scipy.sparse import csr_matrix
        from scipy.sparse.linalg import lsqr

        indices, probabilities = (part.cpu().numpy() for part in self.perceive(observation))
        n, k = indices.shape
        values = self._one_each("value", check_numbers("value", value), n)
        if not np.all(np.abs(values) <= LARGEST_VALUE):
            raise ValueError(f"value must be at most {LARGEST_VALUE:g} in size; got {shown(value)}")
        columns = self.columns_of(self._one_each("action", np.asarray(action), n, self.action_space.shape or ()))
        n_factors, n_actions = columns.shape[1], self.table.n_actions
        points, places = np.unique(indices, return_inverse=True)
        # One row for each observation, one column for each entry of the table.
        entries = places.reshape(n, k, 1) * n_actions + columns[:, None, :]
        shares = np.repeat(probabilities / n_factors, n_factors)
        shape = n, len(points) * n_actions
        weights = csr_matrix((shares, entries.reshape(-1), np.arange(n + 1) * k * n_factors), shape=shape)
        with self.table.lock:
            at = th.from_numpy(points).to(self.table.values.device)
            rows = self.table.rows(at[None])[0].double().cpu().numpy()
            rows += lsqr(weights, values - weights @ rows.reshape(-1), atol=1e-14, btol=1e-14)[0].reshape(rows.shape)
            if not np.all(np.abs(rows) <= LARGEST_VALUE):
                raise ValueError(f"value: entries of the table would exceed {LARGEST_VALUE:g} in size")
            self.table.write(at, th.from_numpy(rows))

    def fill(self, function: Callable[[np.ndarray], Any]) -> None:
        """
        Set the values of all points.

        :param function: from points, shape (n, obs_dim), observation units, to their values, shape (n, n_actions), or
            (n, 1) for all actions alike; called with many points at once
        :raises ValueError: if the range of the observations is not known yet, or the function returns values that do
            not fit; nothing has been changed
        """
        batches = []
        for points, places in self._all_points():
            values = check_numbers("function: the values that it returns", function(places))
            if values.ndim != 2 or values.shape[0] != len(points) or values.shape[1] not in (1, self.table.n_actions):
                raise ValueError(
                    f"function must return an array of shape ({len(points)}, {self.table.n_actions}) or "
                    f"({len(points)}, 1) for {len(points)} points; got shape {values.shape}"
                )
            if not np.all(np.abs(values) <= LARGEST_VALUE):
                raise ValueError(f"function must return values of at most {LARGEST_VALUE:g} in size")
            batches.append((points, np.broadcast_to(values, (len(points), self.table.n_actions))))
        self._write(batches)

    def imitate(self, controller: Any, margin: float | None = None) -> None:
        """
        Make the actions of a controller the greedy ones, and keep the values of the states.

        The controller is asked at each point and at places around it. The action that it takes most often there gets
        the largest value of the point's row, the others that less their share of the margin: the full margin if the
        controller never takes them near the point, and nothing if it takes them as often. So learning, whose values are
        noisy, does not lose the controller at once. The values of the states should be known, by learning from data of
        the controller; ``model.imitate`` does both.

        :param controller: a function from an observation to an action, an SB3 model or policy, or another object whose
            ``predict`` returns (action, state). Its actions must depend on the observation alone
        :param margin: in units of return, > 0; by default 0.3 of the range of the table's values, or 1 if all are
            equal
        :raises ValueError: if an argument is invalid, the controller returns no action of the action space, or the
            range of the observations is not known yet; nothing has been changed
        """
        act = actions_of(controller)
        if margin is None:
            entries = self.table.entries()
            spread = float(entries.max() - entries.min()) if len(entries) else 0.0
            margin = MARGIN_SHARE * spread or 1.0
        margin = check_number("margin", margin, 0.0, LARGEST_VALUE, above=True)
        factors = self.columns.factors
        batches = []
        for points, places in self._all_points():
            shares = np.zeros((len(points), self.table.n_actions))
            rows = np.arange(len(points))[:, None]
            for offsets in self._offsets():
                columns = self.columns_of(act(self._to_observations(places + offsets[points % len(offsets)])))
                shares[rows, columns] += 1.0 / SAMPLES
            values = self.table.rows(self._at(points)[None])[0].double().cpu().numpy()
            for first, end in pairwise(factors):
                lacks = shares[:, first:end].max(axis=1, keepdims=True) - shares[:, first:end]
                values[:, first:end] = values[:, first:end].max(axis=1, keepdims=True) - margin * lacks
            batches.append((points, values))
        self._write(batches)

    def forbid(self, action: Any, region: Any) -> None:
        """
        Forbid actions in a region. There they are neither taken nor explored, nor do their values count; KNNDyna's
        plan does not know of it. The rule is saved with the policy, and does not depend on the points.

        :param action: Discrete actions: one or a list of them. Box actions: the action points in a box, a dict of
            components and their (low, high), or a pair (low, high) of arrays; the action is then the mean of others
        :param region: a box of observations, edges included: a dict of some dimensions and their (low, high), or a pair
            (low, high) of arrays, observation units; an end may be infinite
        :raises ValueError: if an argument is invalid, or no action were left somewhere; nothing has been changed
        """
        space = self.observation_space
        obs_dim = self.perceiver.bounds.obs_dim
        low, high = check_box("region", region, np.full(obs_dim, -np.inf), np.full(obs_dim, np.inf), thin=True)
        if np.isnan([low, high]).any():
            raise ValueError(f"region: an end must be a number, or infinite; got {shown(region)}")
        if isinstance(space, spaces.Box):
            # As observations are: 0.07 is less than the same as a float32.
            low, high = (end.astype(space.dtype).astype(np.float64) for end in (low, high))
        columns = self._columns_in(action)
        with self.table.lock:
            self.rules.add(low, high, columns, self.columns.factors)
            # The kernels hold a copy of the rules.
            self.table.version += 1

    def allow(self) -> None:
        """Allow all actions everywhere again."""
        with self.table.lock:
            self.rules.clear()
            self.table.version += 1

    def doubt(self, observations: np.ndarray, value: float) -> None:
        """
        Set the entries that have not been learned to a low value; in a hashed table those of the points near given
        observations, as it has no others.

        :param observations: shape (n, *obs_shape), observation units
        :param value: their new value
        """
        if isinstance(self.table, DenseTable):
            points = np.arange(len(self.table.values))
        else:
            parts = np.array_split(observations, -(-len(observations) // BATCH))
            points = np.unique(np.concatenate([self.perceive(part).indices.numpy() for part in parts]))
        with self.table.lock:
            rows = self.table.rows(self._at(points)[None])[0]
            self.table.write(self._at(points), rows.masked_fill(rows == self.table.initial_value, value))

    def take_over(self, before: TableEditing, measured: bool) -> None:
        """
        Take the values, the visits, the rules and the measured ranges from a policy with other points.

        :param before: a policy for the same spaces
        :param measured: whether to take its bounds as they are; if not, only the ranges of open dimensions
        :raises ValueError: if the points are too many
        """
        if measured:
            self.perceiver.bounds.load_state_dict(before.perceiver.bounds.state_dict())
        else:
            self.perceiver.bounds.take_over(before.perceiver.bounds)
        self.perceiver.fit()
        self.rules.load_state_dict(before.rules.state_dict())
        table, old = self.table, before.table
        for points, places in self._all_points(known=False):
            perception = before.perceiver(th.from_numpy(places).to(old.values.device))
            rows = old.rows(perception.indices)
            values = mean_rows(rows, perception.probabilities.to(rows.dtype))
            at = self._at(points)
            learned = old.has_visited(perception.indices[:, 0])
            if not isinstance(table, DenseTable):
                at, values = at[learned], values[learned]
            table.write(at, values)
            if isinstance(table, DenseTable):
                table.visit(at[learned])
        table.version += 1

    def _columns_in(self, action: Any) -> np.ndarray:
        """The columns of given actions, shape (n_columns,), bool."""
        columns = np.zeros(self.table.n_actions, np.bool_)
        if isinstance(self.action_space, spaces.Discrete):
            columns[self.columns_of(np.atleast_1d(np.asarray(action)))[:, 0]] = True
            return columns
        points, factors = self.columns.points, self.columns.factors
        n_dims = points.shape[1]
        low, high = check_box("action", action, np.full(n_dims, -np.inf), np.full(n_dims, np.inf), thin=True)
        inside = (low <= points) & (points <= high)
        if len(factors) == 2:
            columns |= inside.all(axis=1)
        else:
            limited = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
            if len(limited) != 1:
                raise ValueError(
                    "action: with action_table='factored' the components of an action are chosen separately, so one "
                    f"component can be forbidden at a time; got {shown(action)}"
                )
            first, end = factors[limited[0]], factors[limited[0] + 1]
            columns[first:end] = inside[first:end, limited[0]]
        if not columns.any():
            raise ValueError(f"action: no action point lies in {shown(action)}; they are {points.tolist()}")
        return columns

    def _one_each(self, name: str, array: np.ndarray, n: int, shape: tuple[int, ...] = ()) -> np.ndarray:
        try:
            return np.broadcast_to(array.reshape(n if array.size > np.prod(shape) else 1, *shape), (n, *shape))
        except ValueError as error:
            raise ValueError(f"{name} must be one, or one for each of {n} observations; got {shown(array)}") from error

    def _all_points(self, known: bool = True) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """
        All points in batches: their indices, and their places, shape (n, obs_dim), observation units. With ``known``,
        their range must be known.
        """
        bounds, points = self.perceiver.bounds, self.perceiver.points
        unknown = bounds.open & bounds.seen_low.isinf()
        if known and unknown.any() and isinstance(points, Lattice):
            raise ValueError(
                f"bounds: the range of the observation dimensions {unknown.nonzero()[:, 0].tolist()} is not known yet, "
                "so the points have no places. Give bounds, or call learn or learn_from first"
            )
        check_size(
            f"points: the values of {points.n_points} points",
            8 * points.n_points * self.table.n_actions,
            "set those of the states that matter with set_q, or give fewer points",
        )
        for batch in th.arange(points.n_points, device=bounds.low.device).split(BATCH):
            yield batch.cpu().numpy(), bounds.unscale(points.coordinates(bounds, batch)).cpu().numpy()

    def _offsets(self) -> Iterator[np.ndarray]:
        """
        Offsets from each point to places around it that are nearer to it than to others, in observation units: shape
        (n_points, obs_dim), or (1, obs_dim) if they are the same for all. The first are 0.
        """
        bounds, points = self.perceiver.bounds, self.perceiver.points
        width = (bounds.high - bounds.low).cpu().numpy() / 2.0
        if not isinstance(self.observation_space, spaces.Box):
            radius = np.zeros((1, points.obs_dim))
        elif isinstance(points, Lattice):
            radius = np.array([[1.0 / max(n - 1, 1) for n in points.shape]])
        else:
            # In a cube within half of the distance to the next point; the nearest one is the point itself.
            squares = self.perceiver.search.query(points.coordinates(bounds))[1][:, :2]
            radius = 0.5 * squares[:, -1:].sqrt().cpu().numpy() / np.sqrt(points.obs_dim)
        random = np.random.default_rng(0)
        for sample in range(SAMPLES):
            yield float(sample > 0) * random.uniform(-1.0, 1.0, (1, points.obs_dim)) * radius * width

    def _to_observations(self, places: np.ndarray) -> np.ndarray:
        """Places as observations of the environment, within its space, shape (n, *obs_shape)."""
        space = self.observation_space
        if isinstance(space, spaces.Box):
            observations: np.ndarray = np.clip(places, space.low, space.high).astype(space.dtype)
        else:
            observations = np.rint(places).astype(np.int64).reshape(len(places), *(space.shape or ()))
        return observations

    def _at(self, points: np.ndarray) -> th.Tensor:
        return th.from_numpy(points).to(self.table.values.device)

    def _write(self, batches: list[tuple[np.ndarray, np.ndarray]]) -> None:
        points, values = (np.concatenate(part) for part in zip(*batches, strict=True))
        self.table.write(self._at(points), th.from_numpy(values))


def actions_of(controller: Any) -> Callable[[np.ndarray], np.ndarray]:
    """
    :param controller: a function from an observation to an action, an SB3 model or policy, or another object whose
        ``predict`` returns (action, state)
    :return: a function from observations, shape (n, *obs_shape), to actions, shape (n, *action_shape)
    :raises ValueError: if it is none of these
    """
    if hasattr(controller, "predict"):
        if isinstance(controller, BaseAlgorithm | BasePolicy):
            return lambda observations: np.asarray(controller.predict(observations, deterministic=True)[0])
        return lambda observations: np.array([controller.predict(each)[0] for each in observations])
    if not callable(controller):
        raise ValueError(
            "controller must be a function from an observation to an action, or an object whose predict returns "
            f"(action, state); got {shown(controller)}"
        )
    return lambda observations: np.array([controller(each) for each in observations])
