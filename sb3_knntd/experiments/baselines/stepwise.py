"""SB3's learning loop for algorithms that act, and learn, one step at a time."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback

SelfStepwiseAlgorithm = TypeVar("SelfStepwiseAlgorithm", bound="StepwiseAlgorithm")


class StepwiseAlgorithm(BaseAlgorithm):
    """
    Base class of algorithms that learn nothing but their policy.

    The parameters are SB3's.
    """

    @abstractmethod
    def _act(self) -> np.ndarray:
        """The next actions, shape (n_envs, *action_shape)."""

    def _learn_from(
        self, new_obs: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        """Learn from the step of the last actions."""

    def learn(
        self: SelfStepwiseAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 100,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfStepwiseAlgorithm:
        """
        Train the model.

        :param total_timesteps: number of environment steps, of all environments together
        :param callback: called at every step, after the update
        :param log_interval: not used, because nothing is logged; part of SB3's signature
        :param tb_log_name: name of the run in TensorBoard
        :param reset_num_timesteps: whether to reset the step counter
        :param progress_bar: whether to show a progress bar (tqdm and rich)
        :return: the model
        """
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        env = self.env
        assert env is not None
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            new_obs, rewards, dones, infos = env.step(self._act())
            self.num_timesteps += env.num_envs
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self._learn_from(new_obs, rewards, dones, infos)  # type: ignore[arg-type]
            self._last_obs = new_obs  # type: ignore[assignment]
            self._update_info_buffer(infos, dones)
            callback.update_locals(locals())
            if not callback.on_step():
                break
        callback.on_training_end()
        return self

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []
