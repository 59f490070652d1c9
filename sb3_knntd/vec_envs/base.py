"""What VecEnvs of environments that are stepped together have in common."""

from __future__ import annotations

import time
import warnings
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn


class BatchStep(NamedTuple):
    """
    One step of all environments.

    :param observations: shape (n_envs, *obs_shape); where an episode ended, as the environments returned them
    :param rewards: shape (n_envs,)
    :param terminated: shape (n_envs,), bool
    :param truncated: shape (n_envs,), bool
    :param infos: a new dict for each environment
    """

    observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    infos: list[dict[str, Any]]


class Turn(NamedTuple):
    """
    Observations where episodes ended.

    :param last: the last observations of the episodes that ended, one row for each
    :param first: the first observations of the next episodes, one row for each
    """

    last: Sequence[Any]
    first: Sequence[Any]


class BatchedVecEnv(VecEnv):
    """
    Base class of VecEnvs whose environments are one object that steps all of them. An environment is reset in the step
    that ends its episode, as SB3 expects. The infos of that step have ``terminal_observation`` and, as from SB3's
    Monitor, ``episode``.

    :param batch: steps all environments
    :param num_envs: number of environments
    :param observation_space: of one environment
    :param action_space: of one environment
    :raises ValueError: if observations are no arrays
    """

    def __init__(
        self, batch: Any, num_envs: int, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        if isinstance(observation_space, spaces.Dict | spaces.Tuple) or observation_space.shape is None:
            raise ValueError(
                f"{type(self).__name__} takes environments whose observations are arrays; got {observation_space}"
            )
        self._batch = batch
        super().__init__(num_envs, observation_space, action_space)
        self._actions: Any = None
        self._began = time.time()
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)

    @abstractmethod
    def _step_all(self, actions: np.ndarray) -> BatchStep:
        """
        :param actions: shape (n_envs, *action_shape)
        """

    @abstractmethod
    def _turn(self, ended: np.ndarray, step: BatchStep) -> Turn:
        """
        Begin new episodes where the last ones ended.

        :param ended: indices of the environments, ascending, at least one
        :param step: the step that ended them
        """

    @abstractmethod
    def _reset_all(self) -> np.ndarray:
        """Reset all environments with the seeds and options of the VecEnv; the first observations."""

    def reset(self) -> np.ndarray:
        """
        :return: the first observations, shape (n_envs, *obs_shape)
        """
        observations = np.ascontiguousarray(self._reset_all())
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: shape (n_envs, *action_shape)
        """
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, shape (n_envs,), whether the episodes have ended, shape (n_envs,), and infos
        """
        step = self._step_all(self._actions)
        observations, rewards, terminated, truncated, infos = step
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        # For few environments this is faster than NumPy's any.
        if True in dones.tolist():
            ended = np.flatnonzero(dones)
            turn = self._turn(ended, step)
            passed = round(time.time() - self._began, 6)
            for env, last in zip(ended.tolist(), turn.last, strict=True):
                info = infos[env]
                info["TimeLimit.truncated"] = not terminated[env]
                info["terminal_observation"] = last
                info["episode"] = {
                    "r": round(float(self._returns[env]), 6),
                    "l": int(self._lengths[env]),
                    "t": passed,
                }
            self._returns[ended] = 0.0
            self._lengths[ended] = 0
            observations[ended] = turn.first
        # As from SB3's VecEnvs: compiled code is made for one order of memory.
        return np.ascontiguousarray(observations), rewards.astype(np.float32, copy=False), dones, infos

    def close(self) -> None:
        """Close the environments."""
        self._batch.close()

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        :param wrapper_class: class of a wrapper
        :param indices: indices of environments, ``None`` for all
        :return: whether it is SB3's Monitor, whose statistics the infos have
        """
        return [issubclass(Monitor, wrapper_class) for _ in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: name of an attribute of the object that steps all environments
        :param indices: indices of environments, ``None`` for all
        :return: its value, once for each environment
        :raises AttributeError: if there is no such attribute
        """
        return [getattr(self._batch, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :raises NotImplementedError: always, as the environments are not separate objects
        """
        raise NotImplementedError(self._no_separate(f"set_attr({attr_name!r})"))

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :raises NotImplementedError: always, as the environments are not separate objects
        """
        raise NotImplementedError(self._no_separate(f"env_method({method_name!r})"))

    def _no_separate(self, call: str) -> str:
        return (
            f"{call}: the environments of {type(self).__name__} are one object, without attributes or methods of each. "
            "Where they are needed, use make_vec_env of stable_baselines3.common.env_util"
        )

    def _images(self) -> Sequence[np.ndarray | None]:
        """An image of each environment."""
        images: Sequence[np.ndarray] = self._batch.render()
        return list(images)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        :return: an image of each environment, ``None`` where they do not render to arrays
        """
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"the environments' render_mode is {self.render_mode!r}; images need 'rgb_array'", stacklevel=2
            )
            return [None] * self.num_envs
        return self._images()


def new_infos(n_envs: int) -> list[dict[str, Any]]:
    """
    :param n_envs: number of environments
    :return: infos of a step that ends no episode
    """
    return [{"TimeLimit.truncated": False} for _ in range(n_envs)]


def add_infos(rows: list[dict[str, Any]], infos: Mapping[str, Any]) -> list[dict[str, Any]]:
    """
    Add infos in the form of gymnasium.vector: by name an array of the environments' values, and by the name after an
    underscore whether each environment has one.

    :param rows: a dict for each environment
    :param infos: by name the values of all environments
    :return: ``rows``
    """
    for name, values in infos.items():
        if name.startswith("_") and name[1:] in infos:
            continue
        if isinstance(values, Mapping):
            values = add_infos([{} for _ in rows], values)
        has = infos.get(f"_{name}")
        for env, row in enumerate(rows):
            if has is None or has[env]:
                row[name] = values[env]
    return rows
