"""The online training loop: base class of SB3 algorithms that learn from each step at once."""

from __future__ import annotations

import sys
import time
from abc import abstractmethod
from collections.abc import Mapping
from statistics import fmean
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_knntd.common.callback_dispatcher import CallbackDispatcher
from sb3_knntd.common.checks import check_number
from sb3_knntd.common.schedules import progress_remaining
from sb3_knntd.common.transitions import StepCheck

SelfOnlineAlgorithm = TypeVar("SelfOnlineAlgorithm", bound="OnlineAlgorithm")


class OnlineAlgorithm(BaseAlgorithm):
    """
    Acts and learns one step at a time. Subclasses implement ``_act`` and ``_learn_from``.

    The parameters are those of SB3's BaseAlgorithm.
    """

    # The observations after the last step; and, while callbacks run, those before it.
    _standing: Any = None
    _acted_on: Any = None
    _step_check: StepCheck | None = None

    @abstractmethod
    def _act(self) -> np.ndarray:
        """The next actions of the environments, shape (n_envs, *action_shape)."""

    def _learn_from(
        self, new_obs: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        """
        Learn from the last step.

        :param new_obs: the current observations, after a reset where an episode ended, shape (n_envs, *obs_shape)
        :param rewards: shape (n_envs,)
        :param dones: whether episodes have ended, shape (n_envs,), bool
        :param infos: one for each environment
        :raises ValueError: if an argument is invalid; nothing has been learned
        :raises FloatingPointError: if values would diverge; nothing has been learned
        """

    def _abandon_episodes(self) -> None:
        """Forget the current episodes and selected actions: the environments have changed state or will be reset."""

    def _conclude(self) -> None:
        """Called at the end of :meth:`learn`."""

    def _checks_steps(self) -> bool:
        """Whether to check that observations are arrays of the shape of the observation space."""
        return True

    def _log(self) -> Mapping[str, float]:
        """Values to log in addition to SB3's."""
        return {}

    def learn(
        self: SelfOnlineAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfOnlineAlgorithm:
        """
        Train for ``total_timesteps`` steps, learning from each step as it is made.

        :param total_timesteps: total number of steps over all environments
        :param callback: called at every step, after learning from it
        :param log_interval: number of episodes between logs, ``None`` for no logs
        :param tb_log_name: name of the run in TensorBoard
        :param reset_num_timesteps: whether to count steps from 0; otherwise training continues
        :param progress_bar: whether to show a progress bar (tqdm and rich)
        :return: the model
        :raises ValueError: if ``total_timesteps`` is no number, or an environment returns an array of the wrong shape
            or a value that is not finite; nothing is learned from that step
        """
        # Like SB3, accept floats such as 1e6, and numbers below 1 (no steps). NaN would silently mean no steps.
        check_number("total_timesteps", total_timesteps)
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        dispatcher = CallbackDispatcher(callback)
        while self.num_timesteps < total_timesteps:
            if not self._step(dispatcher, log_interval):
                break
        dispatcher.flush(self.num_timesteps)
        self.policy.set_training_mode(False)
        callback.on_training_end()
        self._conclude()
        return self

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.env is None:
            raise ValueError("there is no environment to learn from: call set_env(env) first")
        if reset_num_timesteps or self._last_obs is None:
            # The environments are about to be reset.
            self._abandon_episodes()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self._checks_steps():
            self._step_check = StepCheck(self.n_envs, self.observation_space.shape or ())
            self._step_check.reset(self._last_obs)
        self._standing = self._last_obs
        if total_timesteps > self.num_timesteps:
            self._current_progress_remaining = progress_remaining(self.num_timesteps, total_timesteps)
        return total_timesteps, callback

    def _step(self, dispatcher: CallbackDispatcher, log_interval: int | None) -> bool:
        """
        Make one step in every environment, and learn from it.

        :param dispatcher: calls the callbacks
        :param log_interval: number of episodes between logs
        :return: whether training continues
        """
        env = self.env
        assert env is not None
        for each in dispatcher.every_step:
            each.on_rollout_start()
        last_obs = self._last_obs
        if last_obs is not self._standing:
            last_obs = self._follow_callback()
        actions = self._act()
        n_before = self.num_timesteps
        try:
            new_obs, rewards, dones, infos = env.step(actions)
            self.num_timesteps += env.num_envs
            self._current_progress_remaining = progress_remaining(self.num_timesteps, self._total_timesteps)
            if self._step_check is not None:
                self._step_check.step(new_obs, rewards, dones, infos)
            self._learn_from(new_obs, rewards, dones, infos)  # type: ignore[arg-type]
        except BaseException as error:
            step, self.num_timesteps = max(self.num_timesteps, n_before + env.num_envs), n_before
            # The state of the environments is unknown now: the next call of learn must reset them.
            self._last_obs = None
            self._abandon_episodes()
            if type(error) in (ValueError, FloatingPointError):
                raise type(error)(f"at step {step}: {error}. The table is as it was before this step") from error
            raise
        self._standing = new_obs
        ended = dones.tolist()
        any_ended = True in ended
        n_logs = 0
        if any_ended:
            n_logs = self._count_episodes(ended, infos, dones, log_interval)
        else:
            # A loop: a generator would take longer than all of it.
            for info in infos:
                if "episode" in info:
                    self._update_info_buffer(infos, dones)
                    break

        # Observations are not copied: SB3's algorithms also keep the arrays that a VecEnv returned.
        if dispatcher.callbacks and dispatcher.record_step(new_obs, any_ended):  # type: ignore[arg-type]
            self._acted_on = last_obs
            try:
                go_on = dispatcher.dispatch(locals(), self.num_timesteps, any_ended)
            finally:
                self._move_on()
                self._acted_on = None
            if not go_on:
                return False
        else:
            self._last_obs = new_obs  # type: ignore[assignment]
        if n_logs:
            self.dump_logs()
        for each in dispatcher.every_step:
            each.on_rollout_end()
        return True

    def _follow_callback(self) -> Any:
        """Start new episodes where a callback has moved the environments, or reset new ones; the observations."""
        self._abandon_episodes()
        if self._last_obs is None:
            assert self.env is not None
            self._last_obs = self.env.reset()  # type: ignore[assignment]
        if self._step_check is not None:
            self._step_check.reset(self._last_obs)
        return self._last_obs

    def _move_on(self) -> None:
        """Set the last observations to those after the step, unless a callback has set them: then forget episodes."""
        if self._last_obs is self._acted_on:
            self._last_obs = self._standing
        else:
            self._abandon_episodes()

    def _count_episodes(
        self, ended: list[bool], infos: list[dict[str, Any]], dones: np.ndarray, log_interval: int | None
    ) -> int:
        """Count the episodes that ended; the number of logs that are due."""
        self._update_info_buffer(infos, dones)
        before = self._episode_num
        self._episode_num += ended.count(True)
        return self._episode_num // log_interval - before // log_interval if log_interval else 0

    def dump_logs(self) -> None:
        """Write the log, with SB3's keys and those of the algorithm."""
        assert self.ep_info_buffer is not None
        assert self.ep_success_buffer is not None
        elapsed = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        record = self.logger.record
        record("time/episodes", self._episode_num, exclude="tensorboard")
        record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed))
        record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        if len(self.ep_info_buffer) > 0:
            record("rollout/ep_rew_mean", fmean([info["r"] for info in self.ep_info_buffer]))
            record("rollout/ep_len_mean", fmean([info["l"] for info in self.ep_info_buffer]))
        if len(self.ep_success_buffer) > 0:
            record("rollout/success_rate", fmean(self.ep_success_buffer))
        for key, value in self._log().items():
            record(key, value)
        self.logger.dump(step=self.num_timesteps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_standing", "_acted_on", "_step_check"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
