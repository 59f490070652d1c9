"""kNN-TD(λ) for discrete actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_knntd.actions.exploration import EXPLORATIONS
from sb3_knntd.actions.selection import ActionSelector, MeanValueSelector
from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.common.checks import LEAST, check_member, check_word
from sb3_knntd.common.hyperparameters import Hyperparameter
from sb3_knntd.common.schedules import check_rate, make_schedule
from sb3_knntd.kernels.selection import Target
from sb3_knntd.policies import KNNPolicy

SelfKNNTD = TypeVar("SelfKNNTD", bound="KNNTD")


class KNNTD(KNNAlgorithm):
    """
    kNN-TD(λ): SARSA(λ) or Q(λ) with a table of action values at points of the observation space. The values of an
    observation are a weighted mean over its k nearest points.

    Paper: Martin H., de Lope, Maravall, "Robust high performance reinforcement learning through weighted k-nearest
    neighbors", Neurocomputing 74 (2011), https://doi.org/10.1016/j.neucom.2010.07.027. With ``trace_decay=0`` it is
    kNN-TD (Algorithm 2), with ``n_neighbors=1`` in addition NN-TD (Algorithm 1). On Discrete, MultiDiscrete and
    MultiBinary observations it is exact tabular SARSA(λ) or Q(λ).

    .. code-block:: python

        model = KNNTD("MountainCar-v0", seed=0).learn(20_000)
        model.policy.q_table  # the action values at model.policy.points

    :param policy: the environment, since there is only one policy; or, in SB3's order, ``"KNNPolicy"`` or a subclass of
        :class:`~sb3_knntd.KNNPolicy`
    :param env: the environment: a gymnasium id, an environment, or a VecEnv
    :param learning_rate: α >= 0; or a function of the remaining progress (from 1 to 0); or a string for a linear
        schedule over the whole training: ``"lin_0.5_0.05"`` falls from 0.5 to 0.05, ``"lin_0.5"`` falls to 0
    :param gamma: γ, in [0, 1]
    :param trace_decay: λ, in [0, 1], or a function or string as for ``learning_rate``
    :param n_neighbors: k >= 1; ``"auto"`` is 2 obs_dim + 1, a point and its neighbours along each axis, and 1 on
        Discrete, MultiDiscrete and MultiBinary observations
    :param points: the perception points: an int or one int per dimension for a lattice over the bounds, or an array
        (n_points, obs_dim) in observation units for scattered points; ``"auto"`` is a lattice of about 8000 points,
        at most 20 per dimension, or one point per state on Discrete, MultiDiscrete and MultiBinary observations; with
        ``"grow"`` there are none at first, and each observation farther than ``spacing`` from all points becomes one
    :param spacing: of points that grow, in [1e-100, 10⁴], scaled units; ``"auto"`` is 0.06 (obs_dim - 1), at least 0.04
    :param max_points: largest number of points that grow, >= 2. When it is reached, the spacing grows by 2^(1/obs_dim)
        until there is room for more, and points nearer than that to another are dropped
    :param bounds: the range mapped to [-1, 1]: (low, high), arrays (obs_dim,) in observation units; ``None`` takes the
        bounds of the space, and measures the range of unbounded dimensions in a random phase at the start of
        :meth:`learn`, as that of dimensions with a bound that is given as NaN or infinite; a dict such as
        ``{1: (-3, 3)}`` gives the bounds of some dimensions; ``"adaptive"`` measures the range of every dimension, and
        widens it whenever an observation lies outside: the values are then carried over to the new points of the
        lattice, and traces are dropped. With points that grow, the range of these dimensions is the one visited so
        far, from the first step on: when it has grown by more than a tenth, all is scaled anew, and points that have
        come too near to another are dropped
    :param weights: ``"inverse_quadratic"``: 1 / (1 + d²/h²), eq. 5; ``"gaussian"``: exp(-d²/2h²); or a function from
        squared distances (batch, k), scaled units, to weights (batch, k), both torch tensors
    :param bandwidth: h of the weights, >= 1e-100, scaled units (the range of each dimension has width 2)
    :param search: how neighbours are found: ``"brute"``, ``"lattice"``, ``"kd_tree"`` (all exact), ``"hnsw"``
        (approximate, extra ``[ann]``), or ``"auto"`` (exact)
    :param step_size: ``"paper"`` for α as in eq. 13, ``"normalized"`` for α / Σp², which makes α the share of the TD
        error that one update removes
    :param traces: ``"replacing"`` (eq. 16) or ``"accumulating"`` (eq. 15)
    :param reset_other_actions: whether a replacing trace clears those of the other actions at its points (Algorithm
        3, line 16)
    :param target: ``"sarsa"`` (eq. 11), ``"q_learning"`` (eq. 12), or ``"expected_sarsa"``, the mean under the
        exploration policy
    :param exploration: ``"epsilon_greedy"`` or ``"softmax"``
    :param exploration_initial_eps: ε at the start, in [0, 1]
    :param exploration_final_eps: ε at the end, in [0, 1]
    :param exploration_fraction: share of the training over which ε changes, in (0, 1]
    :param temperature: of softmax, >= 1e-100, in units of return, or a function or string as for ``learning_rate``
    :param tie_break: how ties between best actions are broken while training: ``"random"`` or ``"first"``
    :param initial_value: initial Q, up to ±1e30; values above the attainable return make the learner explore
    :param stats_window_size: number of episodes, >= 1, over which logged means are taken
    :param tensorboard_log: folder for TensorBoard, ``None`` for no log
    :param policy_kwargs: ``dtype`` (``torch.float64`` or ``torch.float32``), ``table`` (``"auto"``, ``"dense"``,
        ``"hashed"``) and ``compiled`` (``False`` for the torch reference), see :class:`~sb3_knntd.KNNPolicy`
    :param verbose: 0 for no output, 1 for information, 2 for debugging
    :param seed: seed of all random numbers, from 0 to 2³² - 1
    :param device: device of the perception and the table; on the CPU the step is compiled
    :param _init_setup_model: whether to build the table at once
    :raises ValueError: if an argument is invalid; the message names it, the given value and what is valid
    """

    target: Any = Hyperparameter()
    exploration: Any = Hyperparameter()
    temperature: Any = Hyperparameter()
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"KNNPolicy": KNNPolicy}
    _algorithm: ClassVar[str] = "KNNTD"
    _supported_action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Discrete,)
    _action_space_advice: ClassVar[str] = (
        "For a Box of actions use ExA; MultiDiscrete and MultiBinary can be numbered into one Discrete space by "
        "a gymnasium.ActionWrapper"
    )

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "KNNPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule | str = "lin_0.5_0.05",
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
        target: str = "sarsa",
        exploration: str = "epsilon_greedy",
        exploration_initial_eps: float = 0.3,
        exploration_final_eps: float = 0.0,
        exploration_fraction: float = 0.5,
        temperature: float | Schedule | str = 1.0,
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
        self.target = target
        self.exploration = exploration
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps
        self.exploration_fraction = exploration_fraction
        self.temperature = temperature
        if _init_setup_model:
            self._setup_model()

    def _make_selector(self) -> ActionSelector:
        target = check_member("target", self.target, Target)
        check_word("exploration", self.exploration, EXPLORATIONS)
        exploration = EXPLORATIONS[self.exploration]()
        return MeanValueSelector(
            self.policy.columns, target, exploration, self.tie_break == "random", self.policy.rules
        )

    def _make_exploration_schedule(self) -> Schedule:
        check_word("exploration", self.exploration, EXPLORATIONS)
        epsilon = self._make_epsilon_schedule()
        self.temperature = check_rate("temperature", self.temperature, LEAST)
        return make_schedule(self.temperature) if self.exploration == "softmax" else epsilon

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
