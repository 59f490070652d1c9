"""A model of an environment with continuous observations: local linear fits to the nearest transitions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_knntd.common.arrays import load_arrays, reserve, saved_arrays
from sb3_knntd.kernels import local_model as kernels
from sb3_knntd.kernels.local_model import FitConfig, ModelArrays, TransitionArrays
from sb3_knntd.model.buffer import TransitionBuffer
from sb3_knntd.perception.bounds import Bounds

#: Number of transitions that set the bandwidth of a fit, for each of its inputs.
FITTED_PER_INPUT = 2
#: A list holds this many times as many.
LIST_FACTOR = 3
#: An action is known at a point if it was taken within this distance, in spacings.
REACH = 2.5
#: Half of the range of an action dimension counts as this distance, in spacings.
ACTION_DISTANCE = 2.0


class Prediction(NamedTuple):
    """
    What a model expects after a step.

    :param observation: the expected next observation, shape obs_shape, observation units
    :param reward: the expected reward
    :param end: probability that the next state is terminal
    :param known: whether a similar step has been seen; if not, the prediction is that of the nearest one that was
    :param distance: distance of the nearest step that has been seen, in spacings of the points
    :param error: how far the steps nearby are from the fit: root mean square, shape obs_shape, observation units
    """

    observation: np.ndarray
    reward: float
    end: float
    known: bool
    distance: float
    error: np.ndarray


class LocalModel:
    """
    Predicts the change of the state and the reward from the nearest transitions of a buffer, by a linear fit at each
    point and action.

    :param buffer: the transitions
    :param action_points: the actions of a Box that have a fit, shape (n_actions, action_dim), from -1 to 1 in each
        dimension; for Discrete actions shape (n_actions, 0)
    """

    def __init__(self, buffer: TransitionBuffer, action_points: np.ndarray) -> None:
        self.buffer = buffer
        self.action_points = action_points
        n_actions, action_dim = action_points.shape
        n_inputs = 1 + buffer.obs_dim + action_dim
        self._n_fitted = FITTED_PER_INPUT * n_inputs
        list_size = LIST_FACTOR * self._n_fitted
        self.n_points = 0
        by_action = (0, n_actions)
        self.arrays = ModelArrays(
            points=np.zeros((0, buffer.obs_dim)),
            nearest=np.zeros((*by_action, list_size), np.int32),
            distances=np.zeros((*by_action, list_size)),
            counts=np.zeros(by_action, np.int64),
            coefficients=np.zeros((*by_action, n_inputs, buffer.obs_dim + 1)),
            limits=np.zeros((*by_action, 2, buffer.obs_dim + 1)),
            ends=np.zeros(by_action),
            end_rewards=np.zeros(by_action),
            errors=np.zeros(by_action),
            known=np.zeros(by_action, np.bool_),
            stale=np.zeros(by_action, np.uint8),
        )
        self.data = self._scaled_data(0)

    @property
    def known(self) -> np.ndarray:
        """Whether an action is known at a point, shape (n_points, n_actions), bool."""
        return self.arrays.known[: self.n_points]

    def _scaled_data(self, size: int) -> TransitionArrays:
        obs_dim, action_dim = self.buffer.obs_dim, self.action_points.shape[1]
        return TransitionArrays(
            states=np.zeros((size, obs_dim)),
            next_states=np.zeros((size, obs_dim)),
            actions=np.zeros((size, action_dim)),
            columns=np.zeros(size, np.int64),
            rewards=np.zeros(size),
            terminated=np.zeros(size, np.bool_),
        )

    def scale(self, first: int) -> None:
        """
        Scale the transitions of the buffer.

        :param first: the first one to scale; the others have been
        """
        buffer, n = self.buffer, self.buffer.n_transitions
        if len(self.data.rewards) < n:
            self.data = reserve(self.data, first, max(2 * n, 64))
        chosen = slice(first, n)
        for name, observations in (("states", buffer.observations), ("next_states", buffer.next_observations)):
            getattr(self.data, name)[chosen] = self._bounds.scale(th.from_numpy(observations[chosen])).numpy()
        if self.action_points.shape[1]:
            self.data.actions[chosen] = buffer.actions[chosen] * ACTION_DISTANCE * self.spacing
        else:
            self.data.columns[chosen] = buffer.actions[chosen, 0]
        self.data.rewards[chosen] = buffer.rewards[chosen]
        self.data.terminated[chosen] = buffer.terminated[chosen]

    def set_scale(self, bounds: Bounds, spacing: float) -> None:
        """
        Scale all transitions of the buffer. The lists are not made anew.

        :param bounds: the range that is mapped to [-1, 1]
        :param spacing: h, scaled units
        """
        self._bounds, self.spacing = bounds, spacing
        self.config = FitConfig(
            actions=self.action_points * ACTION_DISTANCE * spacing,
            n_fitted=self._n_fitted,
            spacing=spacing,
            reach=REACH * spacing,
        )
        self.scale(0)

    def lay(self, points: np.ndarray, bounds: Bounds, spacing: float) -> None:
        """
        Begin anew with these points, in a new scale. All fits are stale.

        :param points: shape (n_points, obs_dim), scaled units
        :param bounds: the range that is mapped to [-1, 1]
        :param spacing: h, scaled units
        """
        self.set_scale(bounds, spacing)
        self.n_points = 0
        self.add_points(points)

    def add_points(self, points: np.ndarray) -> None:
        """
        Add points. Their fits are stale.

        :param points: shape (n, obs_dim), scaled units
        """
        first = self.n_points
        n = first + len(points)
        if n > len(self.arrays.points):
            self.arrays = reserve(self.arrays, first, max(2 * n, 64))
        self.arrays.points[first:n] = points
        self.arrays.known[first:n] = False
        self.n_points = n
        kernels.fill_lists(first, n, self.buffer.n_transitions, self.data, self.arrays, self.config)

    def enter(self, transition: int) -> None:
        """
        Enter the last transition of the buffer, which has been scaled, into the lists.

        :param transition: its index
        """
        kernels.enter(transition, self.data, self.arrays, self.config, self.n_points)

    def make_room(self) -> None:
        """Drop the transitions that are in the fewest lists. They say least where there are many."""
        n = self.n_points
        arrays, used = self.arrays, np.zeros(self.buffer.n_transitions, np.int64)
        filled = np.arange(arrays.nearest.shape[2]) < arrays.counts[:n, :, None]
        np.add.at(used, arrays.nearest[:n][filled], 1)
        renumbered = self.buffer.drop(used)
        self.scale(0)
        kernels.renumber(renumbered, arrays, n)
        # What is not in a list is no transition any more.
        left = np.arange(arrays.nearest.shape[2]) < arrays.counts[:n, :, None]
        arrays.nearest[:n][~left] = 0

    def fit(self) -> None:
        """Fit anew where lists have changed."""
        kernels.fit_stale(self.data, self.arrays, self.config, self.n_points)

    def predict(self, observation: np.ndarray, action: np.ndarray) -> Prediction:
        """
        Predict one step by a fit at this observation and action. Planning uses the fit of the nearest point.

        :param observation: shape (obs_dim,), observation units
        :param action: of a Box from -1 to 1 in each dimension, shape (action_dim,); Discrete: the column, shape (1,)
        :return: what is expected after the step; NaN if no such action has been taken yet
        """
        scaled = self._bounds.scale(th.from_numpy(observation.astype(np.float64)))
        is_box = self.action_points.shape[1] > 0
        config = self.config._replace(reach=np.inf)
        if is_box:
            # One action point: the action itself.
            config = config._replace(actions=action[None] * ACTION_DISTANCE * self.spacing)
        model = reserve(self.arrays, 0, 1)
        model.points[0] = scaled.numpy()
        kernels.fill_lists(0, 1, self.buffer.n_transitions, self.data, model, config)
        column = 0 if is_box else int(action[0])
        kernels.fit(0, column, self.data, model, config)
        outputs = np.full(len(scaled) + 1, np.nan)
        if model.known[0, column]:
            kernels.predict(scaled.numpy(), 0, column, np.empty(0), model, outputs)
        end = float(model.ends[0, column])
        distance = float(np.sqrt(model.distances[0, column, 0])) if model.known[0, column] else np.inf
        units = 0.5 * (self._bounds.high - self._bounds.low)
        return Prediction(
            observation=self._bounds.unscale(scaled + th.from_numpy(outputs[:-1])).numpy(),
            reward=float((1.0 - end) * outputs[-1] + end * model.end_rewards[0, column]),
            end=end,
            known=distance <= self.config.reach,
            distance=distance / self.spacing,
            error=(float(model.errors[0, column]) * units).numpy(),
        )

    def predicted_change(self, transition: int) -> np.ndarray | None:
        """
        The change of the state that the fit of the nearest point expects on a transition of the buffer.

        :param transition: its index; it need not have been entered
        :return: shape (obs_dim,), scaled units; ``None`` if the action is not known there
        """
        state = self.data.states[transition]
        point, _ = kernels.nearest_point(state, self.arrays.points, self.n_points)
        column, offset = int(self.data.columns[transition]), np.empty(0)
        if self.action_points.shape[1]:
            offsets = self.data.actions[transition] - self.config.actions
            column = int((offsets**2).sum(axis=1).argmin())
            offset = offsets[column]
        if not self.arrays.known[point, column]:
            return None
        outputs = np.empty(len(state) + 1)
        kernels.predict(state, point, column, offset, self.arrays, outputs)
        return outputs[:-1]

    def state_dict(self) -> dict[str, Any]:
        """
        :return: tensors; the buffer and the scale are saved elsewhere
        """
        return saved_arrays(self.arrays, self.n_points)

    def load_state_dict(self, state: dict[str, Any], n_points: int) -> None:
        """
        Restore the fits. The buffer must have been restored, and the scale set.

        :param state: the return value of :meth:`state_dict`
        :param n_points: number of points
        :raises ValueError: if it is invalid; the message says why
        """
        size = self.arrays.nearest.shape[2]
        ranges = {"nearest": (0, max(self.buffer.n_transitions - 1, 0)), "counts": (0, size)}
        self.arrays = load_arrays(self.arrays, state, n_points, ranges)
        self.n_points = n_points
