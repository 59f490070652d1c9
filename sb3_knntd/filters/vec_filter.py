"""The δs filter as a wrapper of a VecEnv."""

from __future__ import annotations

import pathlib
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_knntd.common.checks import check_finite, check_flag
from sb3_knntd.filters.observer import Observer
from sb3_knntd.filters.saving import load_table, save_table
from sb3_knntd.filters.table import DeltaTable, FilterArguments


class VecDeltaFilter(VecEnvWrapper):
    """
    :class:`~sb3_knntd.DeltaFilter` for vectorised environments. They share one table; each has its own estimate.

    The last observation of an episode, ``infos[i]["terminal_observation"]``, is filtered as well.
    ``infos[i]["raw_observation"]`` and ``infos[i]["raw_terminal_observation"]`` are the observations before filtering.

    Put VecNormalize and VecFrameStack outside: ``VecNormalize(VecDeltaFilter(venv))``. The filter needs single
    observations in units that do not change.

    .. code-block:: python

        venv = VecDeltaFilter(make_vec_env("CartPole-v1", n_envs=8))
        model = PPO("MlpPolicy", venv).learn(50_000)
        venv.save("filter")
        venv = VecDeltaFilter.load("filter", make_vec_env("CartPole-v1"))

    Parameters not named here are those of :class:`~sb3_knntd.DeltaFilter`.

    :param venv: environments with observations in a Box of shape (n,), and Discrete or Box actions
    :param training: whether to learn; can be set at any time, as that of VecNormalize
    :raises ValueError: if an argument or a space does not fit; the message says which, and what would
    """

    def __init__(
        self,
        venv: VecEnv,
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
        normalize = unwrap_vec_normalize(venv)
        normalizes = normalize is not None and normalize.norm_obs
        if normalizes:
            warnings.warn(
                "VecNormalize is inside of VecDeltaFilter: observations change their units while the filter learns, "
                "and off-policy algorithms store those from before both. Better VecNormalize(VecDeltaFilter(venv))",
                stacklevel=2,
            )
        # The bounds of the space do not hold for normalised observations.
        table = DeltaTable(venv.observation_space, venv.action_space, arguments, bounds_from_space=not normalizes)
        #: the table
        self.table = table
        #: whether to learn
        self.training = training
        self.set_venv(venv)

    def set_venv(self, venv: VecEnv) -> None:
        """
        Set the environments to filter. They have to be reset.

        :param venv: environments with the spaces of the filter
        :raises ValueError: if the spaces differ
        """
        self.table.check_spaces(venv.observation_space, venv.action_space)
        VecEnvWrapper.__init__(self, venv)
        self._observer = Observer(self.table, self.num_envs)
        self._columns = np.zeros(self.num_envs, np.int64)
        self._raw_observations: np.ndarray | None = None

    def reset(self) -> np.ndarray:
        """
        :return: the observations, unchanged, shape (n_envs, obs_dim)
        :raises ValueError: if one is not finite
        """
        observations = self.venv.reset()
        assert isinstance(observations, np.ndarray)
        self._observer.begin(list(range(self.num_envs)), observations)
        self._raw_observations = observations.copy()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: shape (n_envs, *action_shape)
        """
        self._columns = self.table.columns(actions)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: what the environments return, with the estimated states as observations
        :raises ValueError: if an observation is not finite; nothing is learned from this step
        """
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, np.ndarray)
        ended = [row for row, done in enumerate(dones.tolist()) if done]
        arrived = observations
        if ended:
            check_finite("an observation", observations[ended], ended)
            arrived = observations.copy()
            for row in ended:
                arrived[row] = infos[row]["terminal_observation"]
        filtered = self._observer.advance(arrived, self._columns, self.training).astype(observations.dtype)
        for row in ended:
            infos[row]["raw_terminal_observation"] = infos[row]["terminal_observation"]
            infos[row]["terminal_observation"] = filtered[row].copy()
        if ended:
            self._observer.begin(ended, observations[ended])
            filtered[ended] = observations[ended]
        self._raw_observations = observations.copy()
        for info, observation in zip(infos, self._raw_observations, strict=True):
            info["raw_observation"] = observation
        return filtered, rewards, dones, infos

    def get_original_obs(self) -> np.ndarray:
        """
        :return: the last observations before filtering, shape (n_envs, obs_dim)
        :raises ValueError: if there are none yet
        """
        if self._raw_observations is None:
            raise ValueError("there are no observations yet: call reset first")
        return self._raw_observations.copy()

    def for_evaluation(self, venv: VecEnv) -> VecDeltaFilter:
        """
        :param venv: other environments with the same spaces
        :return: a filter of them that does not learn, and shares the table of this one, which continues to learn
        :raises ValueError: if the spaces differ
        """
        return self._around(venv, self.table, training=False)

    def save(self, path: str | pathlib.Path) -> None:
        """
        Save the parameters and everything that was learned. The state of the environments is not saved.

        :param path: file, with ``.zip`` added if it has no suffix
        """
        save_table(path, self.table, self.training)

    @classmethod
    def load(cls, path: str | pathlib.Path, venv: VecEnv, trusted: bool = False) -> VecDeltaFilter:
        """
        :param path: file saved by a :class:`VecDeltaFilter` or a :class:`DeltaFilter`
        :param venv: the environments to filter
        :param trusted: whether to unpickle functions in the file (``weights``, ``learning_rate``). That runs code from
            the file
        :return: the filter
        :raises ValueError: if the file is damaged, holds something else, or is for other spaces than those of ``venv``;
            without ``trusted`` also if it holds functions
        """
        return cls._around(venv, *load_table(path, venv.observation_space, venv.action_space, trusted))

    @classmethod
    def _around(cls, venv: VecEnv, table: DeltaTable, training: bool) -> VecDeltaFilter:
        around = cls.__new__(cls)
        around.table, around.training = table, training
        around.set_venv(venv)
        return around

    def __getstate__(self) -> dict[str, Any]:
        """Without the environments, which may not be picklable. :meth:`set_venv` sets new ones."""
        return {"table": self.table, "training": self.training}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
