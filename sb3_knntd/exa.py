"""Ex⟨a⟩(λ) for continuous actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_knntd.actions.selection import ActionSelector, MeanActionSelector
from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.common.checks import check_member, check_number, shown
from sb3_knntd.common.hyperparameters import FixedHyperparameter, Hyperparameter
from sb3_knntd.kernels.selection import Exploration
from sb3_knntd.policies import ExAPolicy

#: ``exploration_hold="auto"``: share of an episode. If draws are kept for longer, a pole falls within fifty steps; if
#: they are kept for less, a car does not leave its valley.
AUTO_HOLD = 1 / 50
#: Upper limit of the mean number of steps for which a draw is kept: random numbers are multiples of 2^-53.
LONGEST_HOLD = 1e15

SelfExA = TypeVar("SelfExA", bound="ExA")


class ExA(KNNAlgorithm):
    """
    Ex⟨a⟩(λ): each of the k nearest points selects the best of a few action points, and the action is their mean,
    weighted by the probabilities of the neighbours (Algorithm 4 of the paper). With ``trace_decay=0`` it is Ex⟨a⟩.

    The TD error is r + γ Σ p'(i) max Q(i, ·) - Σ p(i) max Q(i, ·) (eqs. 24 and 25), also for exploratory actions: the
    selected entries change by the difference between the observed return and the value of the best entries.

    .. code-block:: python

        model = ExA("Pendulum-v1", seed=0).learn(50_000)

    Parameters not named here are those of :class:`~sb3_knntd.KNNTD`; the learning rate falls from 0.7 to 0.05 by
    default.

    :param policy: the environment, since there is only one policy; or, in SB3's order, ``"KNNPolicy"``
    :param env: the environment: a gymnasium id, an environment, or a VecEnv
    :param action_points: the list A of eq. 19: an int >= 2 or one int per dimension for evenly spaced points over the
        action space, or one ascending array per dimension, in action units. Fewer points learn faster: actions between
        them are reached by averaging
    :param action_table: for several action dimensions: ``"joint"``, a column for every combination of their points;
        ``"factored"``, separate columns for each dimension, each with its own greedy index and one TD error for all;
        ``None`` is joint up to 128 combinations
    :param exploration: ``"shared"``: one random column for all neighbours, kept for several steps; ``"per_neighbor"``
        (eq. 27): one for each neighbour; its effect averages out as k grows
    :param exploration_initial_eps: ε at the start, in [0, 1]: with ``"shared"`` the share of the time spent exploring
    :param exploration_final_eps: ε at the end, in [0, 1]
    :param exploration_fraction: share of the training over which ε changes, in (0, 1]
    :param exploration_hold: mean number of steps, in [1, 1e15], for which a shared draw (whether to explore, and which
        column) is kept; ``"auto"`` is a fiftieth of the current mean length of an episode
    :raises ValueError: if an argument is invalid; the message names it, the given value and what is valid
    """

    policy: ExAPolicy
    action_points: Any = FixedHyperparameter()
    action_table: Any = FixedHyperparameter()
    exploration: Any = Hyperparameter()
    exploration_hold: Any = Hyperparameter()
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"KNNPolicy": ExAPolicy}
    _algorithm: ClassVar[str] = "ExA"
    _supported_action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Box,)
    _action_space_advice: ClassVar[str] = "For Discrete actions use KNNTD"

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "KNNPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule | str = "lin_0.7_0.05",
        gamma: float = 0.99,
        trace_decay: float | Schedule | str = 0.9,
        n_neighbors: int | str = "auto",
        points: Any = "auto",
        spacing: float | str = "auto",
        max_points: int = 5000,
        bounds: Any = None,
        weights: str | Callable[[th.Tensor], Any] = "inverse_quadratic",
        bandwidth: float = 1.0,
        search: str = "auto",
        step_size: str = "normalized",
        traces: str = "replacing",
        reset_other_actions: bool = False,
        action_points: Any = 3,
        action_table: str | None = None,
        exploration: str = "shared",
        exploration_initial_eps: float = 0.9,
        exploration_final_eps: float = 0.0,
        exploration_fraction: float = 1.0,
        exploration_hold: float | str = "auto",
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
            spacing=spacing,
            max_points=max_points,
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
        self.action_points = action_points
        self.action_table = action_table
        self.exploration = exploration
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.exploration_hold = exploration_hold
        if _init_setup_model:
            self._setup_model()

    @classmethod
    def _check_spaces(cls, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        super()._check_spaces(observation_space, action_space)
        # SB3 only asserts it, without advice.
        if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
            raise ValueError(
                f"{cls.__name__} takes actions in a Box with finite bounds; got {action_space}. Bound it by a "
                "gymnasium.ActionWrapper"
            )

    def _policy_arguments(self) -> dict[str, Any]:
        return {"action_points": self.action_points, "action_table": self.action_table}

    def _make_selector(self) -> ActionSelector:
        exploration = check_member("exploration", self.exploration, (Exploration.SHARED, Exploration.PER_NEIGHBOR))
        min_persistence, persistence_share = self._persistence()
        return MeanActionSelector(
            self.policy.columns,
            exploration,
            min_persistence,
            persistence_share,
            self.policy.n_neighbors,
            self.tie_break == "random",
            self.policy.rules,
        )

    def _persistence(self) -> tuple[float, float]:
        """Lower limit of the mean number of steps for which a draw is kept, and share of an episode."""
        if not isinstance(self.exploration_hold, str):
            return check_number("exploration_hold", self.exploration_hold, 1.0, LONGEST_HOLD), 0.0
        if self.exploration_hold != "auto":
            raise ValueError(
                f"exploration_hold must be a finite number in [1, {LONGEST_HOLD:g}], or 'auto'; got "
                f"{shown(self.exploration_hold)}"
            )
        return 1.0, AUTO_HOLD

    def _make_exploration_schedule(self) -> Schedule:
        return self._make_epsilon_schedule()

    def _random_actions(self) -> np.ndarray:
        selector = self.policy.selector
        uniforms = self._stream.next()[:, 0, 2 : 2 + selector.n_factors]
        columns = selector.random_columns(uniforms, self._last_obs)  # type: ignore[arg-type]
        actions: np.ndarray = self.policy.columns.points[columns].sum(axis=1)
        return actions

    def learn(
        self: SelfExA,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "ExA",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfExA:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
