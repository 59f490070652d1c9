"""The δs filter as a wrapper of a gymnasium environment."""

from __future__ import annotations

import pathlib
from collections.abc import Callable
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
import torch as th

from sb3_knntd.common.checks import check_flag
from sb3_knntd.filters.observer import Observer
from sb3_knntd.filters.saving import load_table, save_table
from sb3_knntd.filters.table import DeltaTable, FilterArguments


class DeltaFilter(gym.Wrapper[np.ndarray, Any, np.ndarray, Any], gym.utils.RecordConstructorArgs):
    """
    Reduces the noise of observations by learning how the state changes: the k-NN δs filter (Algorithm 5 of the paper),
    with a gain that adapts to the noise.

    It learns δ(s, a), the expected change of the state, in a table over perception points (eqs. 28 and 31 to 33). Each
    step predicts s + δ(s, a) from the last estimate s, and returns the prediction plus a gain times the innovation, the
    difference of the observation from the prediction. With ``learning_rate=0.5, gain=None, warmup=0`` it equals
    Algorithm 5.

    The first observation of an episode is returned unchanged. ``info["raw_observation"]`` is the observation before
    filtering. Estimates can lie slightly outside the bounds of the observation space.

    .. code-block:: python

        env = DeltaFilter(env)
        model = KNNTD(env).learn(50_000)
        env.training = False

    :param env: environment with observations in a Box of shape (n,), and Discrete or Box actions
    :param learning_rate: ``"count"``: one over the visits of an entry, at least 0.001, so that an entry is the mean of
        the changes observed there; α in [0, 1]; or a function of the remaining progress (from 1 to 0)
    :param update: ``"averaging"``: each entry moves towards the observed change; ``"gradient"``: all neighbours move by
        the error of their weighted mean; ``None`` is averaging with ``"count"``, and gradient otherwise
    :param reference: the state that changes are measured and predicted from: the last ``"filtered"`` or the last
        ``"observed"`` one
    :param gain: factor of the innovation: ``"adaptive"``, in each dimension from the correlation of successive
        innovations, which is zero for the steady-state Kalman filter (Mehra, "On the identification of variances and
        adaptive Kalman filtering", 1970); a number in (0, 1], or one per dimension; ``None``: only the update of the
        table corrects the estimate, as in Algorithm 5
    :param warmup: number of visits, as the weighted mean over the neighbours, from which on a prediction is trusted;
        until then the observation is returned unchanged. A visit is divided among the neighbours by their probabilities
    :param n_neighbors: k >= 1; ``"auto"`` is 2 obs_dim + 1
    :param points: see :class:`~sb3_knntd.KNNTD`; ``"auto"`` is a lattice of about 2000 points, at most 20 per
        dimension
    :param bounds: see :class:`~sb3_knntd.KNNTD`; the range of unbounded dimensions is measured over the first 1000
        observations, or 100 per environment if those are more, which are returned unchanged
    :param weights: see :class:`~sb3_knntd.KNNTD`
    :param bandwidth: see :class:`~sb3_knntd.KNNTD`
    :param search: see :class:`~sb3_knntd.KNNTD`
    :param action_points: for Box actions, each of which is represented by its nearest point: an int >= 2 or one int per
        dimension for evenly spaced points, or ascending arrays, one per dimension, in action units
    :param total_timesteps: number of steps that a schedule of the learning rate spans
    :param training: whether to learn; can be set at any time
    :param compiled: whether to use the compiled step where possible: with numba, and weights that are not a function
    :raises ValueError: if an argument or a space does not fit; the message says which, and what would
    """

    def __init__(
        self,
        env: gym.Env[np.ndarray, Any],
        learning_rate: float | str | Callable[[float], float] = "count",
        update: str | None = None,
        reference: str = "filtered",
        gain: Any = "adaptive",
        warmup: float = 1.0,
        n_neighbors: int | str = "auto",
        points: Any = "auto",
        bounds: Any = None,
        weights: str | Callable[[th.Tensor], Any] = "inverse_quadratic",
        bandwidth: float = 1.0,
        search: str = "auto",
        action_points: Any = 5,
        total_timesteps: int | None = None,
        training: bool = True,
        compiled: bool = True,
    ) -> None:
        arguments = FilterArguments.of(locals())
        training = check_flag("training", training)
        self._set_up(env, DeltaTable(env.observation_space, env.action_space, arguments), training)

    def _set_up(self, env: gym.Env[np.ndarray, Any], table: DeltaTable, training: bool) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, **table.arguments.to_dict(), training=training)
        gym.Wrapper.__init__(self, env)
        #: the table
        self.table = table
        #: whether to learn
        self.training = training
        self._observer = Observer(table, 1)
        self._dtype = table.observation_space.dtype
        self._raw_observation: np.ndarray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param seed: see :meth:`gymnasium.Env.reset`
        :param options: see :meth:`gymnasium.Env.reset`
        :return: the observation, unchanged, and info with ``raw_observation``
        :raises ValueError: if the observation is not finite
        """
        observation, info = self.env.reset(seed=seed, options=options)
        self._observer.begin([0], np.asarray(observation)[None])
        self._raw_observation = observation
        return observation, {**info, "raw_observation": observation}

    def step(self, action: Any) -> tuple[np.ndarray, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: see :meth:`gymnasium.Env.step`
        :return: what the environment returns, with the estimated state as observation, and ``raw_observation`` in info
        :raises ValueError: if the observation is not finite; nothing is learned from it
        """
        columns = self.table.columns(np.asarray(action)[None])
        observation, reward, terminated, truncated, info = self.env.step(action)
        filtered = self._observer.advance(np.asarray(observation)[None], columns, self.training)[0]
        self._raw_observation = observation
        info = {**info, "raw_observation": observation}
        return filtered.astype(self._dtype), reward, terminated, truncated, info

    def get_original_obs(self) -> np.ndarray:
        """
        :return: the last observation before filtering, shape (obs_dim,)
        :raises ValueError: if there is none yet
        """
        if self._raw_observation is None:
            raise ValueError("there is no observation yet: call reset first")
        return np.array(self._raw_observation)

    def for_evaluation(self, env: gym.Env[np.ndarray, Any]) -> DeltaFilter:
        """
        :param env: another environment with the same spaces
        :return: a filter of it that does not learn, and shares the table of this one, which continues to learn
        :raises ValueError: if the spaces differ
        """
        self.table.check_spaces(env.observation_space, env.action_space)
        return self._around(env, self.table, training=False)

    def save(self, path: str | pathlib.Path) -> None:
        """
        Save the parameters and everything that was learned. The state of the environment is not saved.

        :param path: file, with ``.zip`` added if it has no suffix
        """
        save_table(path, self.table, self.training)

    @classmethod
    def load(cls, path: str | pathlib.Path, env: gym.Env[np.ndarray, Any], trusted: bool = False) -> DeltaFilter:
        """
        :param path: file saved by a :class:`DeltaFilter` or a :class:`VecDeltaFilter`
        :param env: the environment to filter
        :param trusted: whether to unpickle functions in the file (``weights``, ``learning_rate``). That runs code from
            the file
        :return: the filter
        :raises ValueError: if the file is damaged, holds something else, or is for other spaces than those of ``env``;
            without ``trusted`` also if it holds functions
        """
        return cls._around(env, *load_table(path, env.observation_space, env.action_space, trusted))

    @classmethod
    def _around(cls, env: gym.Env[np.ndarray, Any], table: DeltaTable, training: bool) -> DeltaFilter:
        around = cls.__new__(cls)
        around._set_up(env, table, training)
        return around
