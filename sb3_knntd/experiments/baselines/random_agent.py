"""Random actions, the lower baseline of every comparison."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs

from sb3_knntd.online_algorithm import OnlineAlgorithm


class RandomPolicy(BasePolicy):
    """
    Samples actions from the action space, independently of the observation.

    :param observation_space: observation space
    :param action_space: any action space that SB3 supports
    """

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        first = next(iter(observation.values())) if isinstance(observation, dict) else observation
        return th.from_numpy(self.draw(len(first)))

    def draw(self, n_envs: int) -> np.ndarray:
        """
        :param n_envs: number of actions
        :return: random actions, shape (n_envs, *action_shape)
        """
        return np.stack([np.asarray(self.action_space.sample()) for _ in range(n_envs)])


class RandomAgent(OnlineAlgorithm):
    """
    An algorithm that takes random actions and does not learn.

    :param policy: ``"RandomPolicy"``
    :param env: environment, or its id
    :param policy_kwargs: not used; part of SB3's signature
    :param tensorboard_log: folder of the TensorBoard log, ``None`` for no log
    :param verbose: 0 for no output
    :param seed: seed of the actions and the environment
    :param device: device of the tensors
    :param _init_setup_model: whether to build the policy in the constructor
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"RandomPolicy": RandomPolicy}
    policy: RandomPolicy

    def __init__(
        self,
        policy: str | type[RandomPolicy],
        env: GymEnv | str,
        policy_kwargs: dict[str, Any] | None = None,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "cpu",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=0.0,
            policy_kwargs=policy_kwargs,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            supported_action_spaces=(spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary),
        )
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self.set_random_seed(self.seed)
        self.policy = RandomPolicy(self.observation_space, self.action_space)

    def _checks_steps(self) -> bool:
        # Observations may be of any kind.
        return False

    def _act(self) -> np.ndarray:
        return self.policy.draw(self.n_envs)
