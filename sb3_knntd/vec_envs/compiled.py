"""SB3's DummyVecEnv with compiled steps, for the paper's environments."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_knntd.envs.base import PaperEnv, State
from sb3_knntd.vec_envs.base import new_infos
from sb3_knntd.vec_envs.dynamics import DYNAMICS, ELAPSED, END, LIMIT, TRUNCATED

#: A time limit of environments without one.
NO_LIMIT = np.iinfo(np.int64).max


class CompiledVecEnv(DummyVecEnv):
    """
    SB3's DummyVecEnv for ``sb3_knntd/MountainCar-v0``, ``CartPole-v0``, ``ContinuousCartPole-v0`` and ``Acrobot-v0``,
    whose steps are one call of compiled code. Observations, rewards and infos are those of DummyVecEnv, bit for bit.

    .. code-block:: python

        venv = make_vec_env("sb3_knntd/MountainCar-v0", n_envs=64, vec_env_cls=CompiledVecEnv)

    With noise, observations are made in Python, which takes longer.

    :param env_fns: functions that make the environments, one for each: all of one class, in no wrappers but SB3's
        Monitor and those of ``gymnasium.make``
    :raises ValueError: if they make other environments, or some that are to be shown in a window
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env[Any, Any]]]) -> None:
        super().__init__(env_fns)
        self._wrappers = [_wrappers(env) for env in self.envs]
        self._cores: list[PaperEnv[Any]] = [env.unwrapped for env in self.envs]  # type: ignore[misc]
        kinds = {type(core) for core in self._cores}
        if len(kinds) > 1 or not kinds <= DYNAMICS.keys():
            raise ValueError(
                f"CompiledVecEnv takes environments of one of the classes "
                f"{', '.join(kind.__name__ for kind in DYNAMICS)}; got "
                f"{', '.join(sorted(kind.__name__ for kind in kinds))}. Use DummyVecEnv"
            )
        if self.render_mode == "human":
            raise ValueError("CompiledVecEnv does not show its environments in a window. Use DummyVecEnv")
        first = self._cores[0]
        for core in self._cores:
            if core.observation_space != first.observation_space or core.action_space != first.action_space:
                raise ValueError(
                    f"CompiledVecEnv takes environments with the same spaces; got {first.observation_space} and "
                    f"{core.observation_space}, {first.action_space} and {core.action_space}"
                )
        self._dynamics = DYNAMICS[type(first)]
        n, dim = self.num_envs, len(first._low)
        self._choices = self._dynamics.choices(first)
        self._bounds = np.stack((first._low, first._high))
        self._pushes = np.zeros(n)
        self._states = np.zeros((n, dim + 1))
        self._counts = np.zeros((n, 3), np.int64)
        # Whether the environments hold the states, and have to be read before the next step.
        self._handed_out = True

    def reset(self) -> VecEnvObs:
        """
        :return: the first observations, shape (n_envs, *obs_shape)
        """
        self._counts[:, ELAPSED] = 0
        self._handed_out = True
        return super().reset()

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: observations, rewards, shape (n_envs,), whether the episodes have ended, shape (n_envs,), and infos
        :raises ValueError: if an action is invalid; no environment has been stepped
        """
        if self._handed_out:
            self._read()
        n, dim = self.num_envs, self._bounds.shape[1]
        observations, rewards, dones = np.empty((n, dim), np.float32), np.empty(n, np.float32), np.empty(n, np.bool_)
        wrong = self._dynamics.push(self._checked(self.actions), self._choices, self._pushes)
        if wrong >= 0:
            # The environment says what is wrong.
            self._cores[wrong].step(self.actions[wrong])
        n_ended = self._dynamics.step(
            self._pushes, self._settings, self._states, self._bounds, self._counts, observations, rewards, dones
        )
        infos = new_infos(n)
        if self._noisy:
            self._observe_noisily(observations, infos)
        if n_ended:
            for env in np.flatnonzero(dones).tolist():
                self._end(env, observations, infos[env])
        return observations, rewards, dones, infos

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        """The actions in the type and shape that compiled code is made for."""
        shape = (self.num_envs, *(self.action_space.shape or ()))
        given = np.asarray(actions)
        if given.shape != shape:
            raise ValueError(f"actions must have the shape {shape}, one for each environment; got {given.shape}")
        if not self._choices.size:
            return given.astype(np.float64, copy=False)
        if given.dtype.kind not in "iu":
            self._cores[0].step(given[0])
        return given.astype(np.int64, copy=False)

    def _observe_noisily(self, observations: np.ndarray, infos: list[dict[str, Any]]) -> None:
        for env, core in enumerate(self._cores):
            core.state = self._state_of(env)
            observations[env] = core._observe()
            infos[env].update(core._info())

    def _end(self, env: int, observations: np.ndarray, info: dict[str, Any]) -> None:
        """End the episode of an environment and begin the next one."""
        info["TimeLimit.truncated"] = bool(self._counts[env, END] == TRUNCATED)
        info["terminal_observation"] = observations[env].copy()
        monitor = self._wrappers[env].get(Monitor)
        if monitor is not None:
            _record(monitor, float(self._states[env, -1]), int(self._counts[env, ELAPSED]), info)
            monitor.needs_reset = False
        # The wrappers have nothing to do, and would take longer than the reset itself.
        observations[env], self.reset_infos[env] = self._cores[env].reset()
        limit = self._wrappers[env].get(TimeLimit)
        if limit is not None:
            limit._elapsed_steps = 0
        self._counts[env, ELAPSED] = 0
        self._read_one(env)

    # ------------------------------------------------- states of the environments

    def _state_of(self, env: int) -> State:
        return tuple(self._states[env, :-1].tolist())

    def _read(self) -> None:
        """Take the states and settings of the environments, which may have been changed from outside."""
        self._settings = np.array([self._dynamics.settings(core) for core in self._cores])
        self._noisy = any(core._noisy for core in self._cores)
        for env in range(self.num_envs):
            self._read_one(env)
        self._handed_out = False

    def _read_one(self, env: int) -> None:
        limit, counts = self._wrappers[env].get(TimeLimit), self._counts[env]
        self._states[env, :-1] = self._cores[env]._known_state()
        counts[LIMIT] = NO_LIMIT if limit is None else limit._max_episode_steps
        if limit is not None:
            counts[ELAPSED] = limit._elapsed_steps
        if counts[ELAPSED] == 0:
            self._states[env, -1] = 0.0

    def _hand_out(self) -> None:
        """Give the environments their states, for calls from outside."""
        if self._handed_out:
            return
        for env, core in enumerate(self._cores):
            core.state = self._state_of(env)
            self._dynamics.show(core, float(self._pushes[env]))
            limit = self._wrappers[env].get(TimeLimit)
            if limit is not None:
                limit._elapsed_steps = int(self._counts[env, ELAPSED])
        self._handed_out = True

    def get_images(self) -> Sequence[np.ndarray | None]:
        """
        :return: an image of each environment, ``None`` where they do not render to arrays
        """
        self._hand_out()
        return super().get_images()

    def _get_target_envs(self, indices: VecEnvIndices) -> list[gym.Env[Any, Any]]:
        # What asks for the environments may read and change them.
        if hasattr(self, "_handed_out"):
            self._hand_out()
        return super()._get_target_envs(indices)


def _wrappers(env: gym.Env[Any, Any]) -> dict[type, Any]:
    """The wrappers of an environment by class; all are known, and none is there twice."""
    found: dict[type, Any] = {}
    while isinstance(env, gym.Wrapper):
        # RL Zoo replaces gymnasium's class by its own, which acts the same on these environments.
        kind = TimeLimit if type(env).__name__ in ("TimeLimit", "PatchedTimeLimit") else type(env)
        if kind not in (Monitor, TimeLimit, OrderEnforcing, PassiveEnvChecker) or kind in found:
            raise ValueError(
                f"CompiledVecEnv makes the steps of environments itself, in one Monitor and the wrappers of "
                f"gymnasium.make; it would leave out {kind.__name__}. Use DummyVecEnv, or a wrapper of the VecEnv"
            )
        found[kind] = env
        env = env.env
    return found


def _record(monitor: Any, total: float, length: int, info: dict[str, Any]) -> None:
    """Record an episode that ended as SB3's Monitor does, which has not seen its steps."""
    passed = time.time() - monitor.t_start
    episode = {"r": round(total, 6), "l": length, "t": round(passed, 6)}
    episode |= {key: info[key] for key in monitor.info_keywords}
    monitor.episode_returns.append(total)
    monitor.episode_lengths.append(length)
    monitor.episode_times.append(passed)
    monitor.total_steps += length
    episode |= monitor.current_reset_info
    if monitor.results_writer:
        monitor.results_writer.write_row(episode)
    info["episode"] = episode
