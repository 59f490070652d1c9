"""kNN-TD(λ) for discrete actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.checks import check_number, check_schedule, check_word
from sb3_knntd.exploration import EXPLORATIONS
from sb3_knntd.policies import KNNPolicy
from sb3_knntd.rules import ActionRule, DiscreteRule

SelfKNNTD = TypeVar("SelfKNNTD", bound="KNNTD")


class KNNTD(KNNAlgorithm):
    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "KNNPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule = LinearSchedule(0.5, 0.05, 1.0),  # noqa: B008
        gamma: float = 0.99,
        trace_decay: float | Schedule = 0.9,
        n_neighbors: int | str = "auto",
        points: Any = "auto",
        bounds: Any = None,
        weights: str | Callable[[th.Tensor], Any] = "inverse_quadratic",
        bandwidth: float = 1.0,
        search: str = "auto",
        step_size: str = "normalized",
        traces: str = "replacing",
        reset_other_actions: bool = False,
        target: str = "sarsa",
        exploration: str = "epsilon_greedy",
        exploration_initial_eps: float = 0.3,
        exploration_final_eps: float = 0.0,
        exploration_fraction: float = 0.5,
        temperature: float | Schedule = 1.0,
        tie_break: str = "random",
        initial_value: float = 0.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "cpu",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            gamma=gamma,
            trace_decay=trace_decay,
            n_neighbors=n_neighbors,
            points=points,
            bounds=bounds,
            weights=weights,
            bandwidth=bandwidth,
            search=search,
            step_size=step_size,
            traces=traces,
            reset_other_actions=reset_other_actions,
            tie_break=tie_break,
            initial_value=initial_value,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.target = target
        self.exploration = exploration
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.temperature = temperature
        if _init_setup_model:
            self._setup_model()

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"KNNPolicy": KNNPolicy}
    _supported_action_space: ClassVar[type[spaces.Space[Any]]] = spaces.Discrete
    _action_space_advice: ClassVar[str] = (
        "For a Box of actions use ExA; MultiDiscrete and MultiBinary can be numbered into one Discrete space by "
        "a gymnasium.ActionWrapper"
    )

    def _make_rule(self) -> ActionRule:
        check_word("target", self.target, ["sarsa", "q_learning", "expected_sarsa"])
        return DiscreteRule(self.target, EXPLORATIONS[self.exploration](), self.tie_break == "random")

    def _make_exploration_schedule(self) -> Schedule:
        check_word("exploration", self.exploration, EXPLORATIONS)
        if self.exploration == "softmax":
            check_schedule("temperature", self.temperature, 0.0, above=True)
            return FloatSchedule(self.temperature)
        check_number("exploration_initial_eps", self.exploration_initial_eps, 0.0, 1.0)
        check_number("exploration_final_eps", self.exploration_final_eps, 0.0, 1.0)
        check_number("exploration_fraction", self.exploration_fraction, 0.0, 1.0, above=True)
        return LinearSchedule(self.exploration_initial_eps, self.exploration_final_eps, self.exploration_fraction)

    def _env_actions(self, actions: np.ndarray) -> np.ndarray:
        assert isinstance(self.action_space, spaces.Discrete)
        start = self.action_space.start
        return actions + start if start else actions

    def learn(
        self: SelfKNNTD,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "KNNTD",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfKNNTD:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
