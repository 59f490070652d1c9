"""SB3's DummyVecEnv with cheaper copies."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

#: Types whose values cannot change, so that they need no copy.
CONSTANT = (bool, int, float, str, type(None))


class LeanVecEnv(DummyVecEnv):
    """
    SB3's DummyVecEnv, which returns the same. With one environment, a third of DummyVecEnv's step goes into
    ``copy.deepcopy``; here arrays are copied by NumPy, and constants in infos not at all. ``KNNTD`` and ``ExA`` put an
    environment that is no VecEnv into it.

    :param env_fns: functions that make the environments
    """

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, shape (n_envs,), whether the episodes have ended, shape (n_envs,), and infos
        """
        infos = []
        for index, env in enumerate(self.envs):
            observation, reward, terminated, truncated, info = env.step(self.actions[index])
            self.buf_rews[index] = reward
            self.buf_dones[index] = ended = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if ended:
                info["terminal_observation"] = observation
                observation, self.reset_infos[index] = env.reset()
            self.buf_infos[index] = info
            self._save_obs(index, observation)
            infos.append({key: value if type(value) in CONSTANT else deepcopy(value) for key, value in info.items()})
        return self._obs_from_buf(), self.buf_rews.copy(), self.buf_dones.copy(), infos

    def _obs_from_buf(self) -> VecEnvObs:
        if self.keys != [None]:
            return super()._obs_from_buf()
        observations: np.ndarray[Any, Any] = self.buf_obs[None].copy()  # type: ignore[index]
        return observations
