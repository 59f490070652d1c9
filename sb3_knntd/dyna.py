"""KNNDyna: a model from nearest transitions, and planning on a table."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_knntd.actions.exploration import EpsilonGreedy
from sb3_knntd.actions.peak import PeakSelector
from sb3_knntd.actions.selection import ActionSelector, MeanValueSelector
from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.common.checks import check_integer, check_number
from sb3_knntd.common.hyperparameters import FixedHyperparameter, Hyperparameter
from sb3_knntd.common.schedules import make_schedule
from sb3_knntd.dyna_policies import BANDWIDTH, DynaBoxPolicy, DynaPolicy, policy_for
from sb3_knntd.insight.diagnosis import Checklist
from sb3_knntd.kernels.selection import Target
from sb3_knntd.learners import Learner, Transitions
from sb3_knntd.model import Prediction, TransitionBuffer
from sb3_knntd.model.rewards import compiled_reward
from sb3_knntd.perception.growing import Growth
from sb3_knntd.planning import DynaLearner, LocalPlanner, Planner, PlanSettings, StatePlanner
from sb3_knntd.planning.diagnosis import CHECKLIST
from sb3_knntd.policies import KNNPolicy

SelfKNNDyna = TypeVar("SelfKNNDyna", bound="KNNDyna")

#: k over (obs_dim + 1)
NEIGHBORS_PER_DIMENSION = 3


class KNNDyna(KNNAlgorithm):
    """
    Learns a model of the environment from nearest transitions, and plans on a table of action values at the states that
    were visited. For environments of a few dimensions in which steps are dear: it needs far fewer steps than
    :class:`~sb3_knntd.KNNTD` and :class:`~sb3_knntd.ExA`, and more computation for each.

    The model predicts the change of the state and the reward at each point and action by a linear fit to the nearest
    transitions (locally weighted regression: Atkeson, Moore and Schaal, Artificial Intelligence Review 11, 1997).
    Value iteration over held actions (Gordon, ICML 1995) explores by an optimistic value for what is not known (R-max:
    Brafman and Tennenholtz, JMLR 3, 2002), and simulated episodes improve the policy by TD(λ) on the table (Dyna:
    Sutton, ICML 1990). With Discrete, MultiDiscrete and MultiBinary observations the model counts transitions, and
    value iteration is exact.

    .. code-block:: python

        model = KNNDyna("Pendulum-v1", seed=0).learn(2_000)
        model.predict_next(observation, action)  # what the model expects

    :param policy: the environment, since there is only one policy; or, in SB3's order, ``"KNNPolicy"``
    :param env: the environment: a gymnasium id, an environment, or a VecEnv, with Discrete or bounded Box actions
    :param learning_rate: α of the simulated steps, in [0, 1]
    :param gamma: γ, in [0, 1]
    :param trace_decay: λ of the simulated steps, in [0, 1]
    :param buffer_size: largest number of transitions that are remembered. When it is reached, a tenth is dropped:
        those that the fewest local models use, as they lie where there are many
    :param spacing: h: no two points are nearer than this, scaled units (the range of each dimension has width 2);
        ``"auto"``: 0.06 (obs_dim - 1), at least 0.04
    :param max_points: largest number of points; when it is reached, the spacing grows
    :param bounds: the range mapped to [-1, 1]: ``"adaptive"``, that of what was visited; or (low, high), arrays
        (obs_dim,) in observation units; or ``None``, the bounds of the space
    :param action_points: of a Box of actions: an int or one int per dimension for evenly spaced points, or a list of
        one array per dimension in action units. The policy interpolates between them
    :param simulated_steps: number of simulated steps for each step of the environment
    :param optimism: how much better than all seen what is not known is taken to be while exploring, in ranges of the
        rewards of a step
    :param reward_function: the reward as a function of (observation, action, next observation), if it is known:
        float64 arrays of shapes (obs_dim,), (action_dim,) and (obs_dim,), a Discrete action an int. It replaces the
        rewards of the environment, and is compiled by numba, which takes some 20 seconds. ``None``: the reward is
        learned
    :param stats_window_size: number of episodes, >= 1, over which logged means are taken
    :param tensorboard_log: folder for TensorBoard, ``None`` for no log
    :param policy_kwargs: ``dtype`` (``torch.float64`` or ``torch.float32``), see :class:`~sb3_knntd.KNNPolicy`
    :param verbose: 0 for no output, 1 for information, 2 for debugging
    :param seed: seed of all random numbers, from 0 to 2³² - 1
    :param device: device of the table; planning is on the CPU
    :param _init_setup_model: whether to build the table at once
    :raises ValueError: if an argument is invalid; the message names it, the given value and what is valid
    """

    learner: DynaLearner
    checklist: ClassVar[Checklist] = CHECKLIST
    _refinable: ClassVar[tuple[str, ...]] = ()
    buffer_size: Any = FixedHyperparameter()
    action_points: Any = FixedHyperparameter()
    reward_function: Any = FixedHyperparameter()
    simulated_steps: Any = Hyperparameter()
    optimism: Any = Hyperparameter()
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"KNNPolicy": KNNPolicy}
    _algorithm: ClassVar[str] = "KNNDyna"
    _supported_action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]] = (spaces.Discrete, spaces.Box)
    _action_space_advice: ClassVar[str] = (
        "MultiDiscrete and MultiBinary can be numbered into one Discrete space by a gymnasium.ActionWrapper"
    )

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv = "KNNPolicy",
        env: GymEnv | str | None = None,
        learning_rate: float | Schedule | str = 0.2,
        gamma: float = 0.99,
        trace_decay: float | Schedule | str = 0.9,
        buffer_size: int = 100_000,
        spacing: float | str = "auto",
        max_points: int = 2000,
        bounds: Any = "adaptive",
        action_points: Any = 3,
        simulated_steps: int = 100,
        optimism: float = 3.0,
        reward_function: Callable[[np.ndarray, np.ndarray, np.ndarray], float] | None = None,
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
            n_neighbors="auto",
            points="auto",
            spacing=spacing,
            max_points=max_points,
            bounds=bounds,
            weights="gaussian",
            bandwidth=1.0,
            search="auto",
            step_size="normalized",
            traces="replacing",
            reset_other_actions=False,
            tie_break="random",
            initial_value=0.0,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.buffer_size = buffer_size
        self.action_points = action_points
        self.simulated_steps = simulated_steps
        self.optimism = optimism
        self.reward_function = reward_function
        if _init_setup_model:
            self._setup_model()

    # ----------------------------------------------------------------- set-up

    @classmethod
    def _check_spaces(cls, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        super()._check_spaces(observation_space, action_space)
        if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
            raise ValueError(
                f"{cls.__name__} takes Box actions with finite bounds; got {action_space}. Bound them by a "
                "gymnasium.ActionWrapper"
            )

    def _setup_model(self) -> None:
        if hasattr(self, "observation_space"):
            self._is_set_up = False
            self._lay_out()
        super()._setup_model()

    def _lay_out(self) -> None:
        """Choose the policy and how it reads its table by the spaces."""
        fitting = policy_for(self.action_space)
        if self.policy_class is KNNPolicy:
            self.policy_class = fitting
        elif not issubclass(self.policy_class, fitting):
            raise ValueError(
                f"policy of KNNDyna must be {fitting.__name__} or a subclass where actions are in a "
                f"{fitting.acts_in.__name__}; got {self.policy_class.__name__}. Call KNNDyna(env), or in SB3's order "
                'KNNDyna("KNNPolicy", env)'
            )
        if isinstance(self.observation_space, spaces.Box):
            obs_dim = int(np.prod(self.observation_space.shape))
            growing = Growth(self.spacing, self.max_points).make_points(obs_dim)
            self.points, self.n_neighbors = "grow", NEIGHBORS_PER_DIMENSION * (obs_dim + 1)
            self.bandwidth = BANDWIDTH * growing.initial_spacing
        elif isinstance(self.bounds, str):
            self.bounds = None

    def _check_parameters(self) -> None:
        super()._check_parameters()
        check_integer("buffer_size", self.buffer_size, 100)
        check_integer("simulated_steps", self.simulated_steps, 0)
        check_number("optimism", self.optimism, 0.0)

    def _policy_arguments(self) -> dict[str, Any]:
        if isinstance(self.action_space, spaces.Box):
            return {"action_points": self.action_points, "action_table": "joint"}
        return {}

    def _make_selector(self) -> ActionSelector:
        if isinstance(self.action_space, spaces.Box):
            return PeakSelector(self.policy.columns, random_ties=True, rules=self.policy.rules)
        return MeanValueSelector(
            self.policy.columns, Target.Q_LEARNING, EpsilonGreedy(), random_ties=True, rules=self.policy.rules
        )

    def _make_exploration_schedule(self) -> Schedule:
        return make_schedule(0.0)

    def _make_learner(self) -> Learner:
        return DynaLearner(self.policy, self._make_planner(), self._stream, self.n_envs, self._update_config())

    def _make_planner(self) -> Planner:
        policy, settings = self.policy, self._plan_settings()
        if not isinstance(self.observation_space, spaces.Box):
            if self.reward_function is not None:
                raise ValueError("reward_function needs a Box of observations; with counted states the reward is exact")
            return StatePlanner(policy, settings)
        columns = policy.columns
        action_points = columns.scale(columns.points) if columns.lists else columns.points
        buffer = TransitionBuffer(int(self.buffer_size), policy.perceiver.bounds.obs_dim, max(len(columns.lists), 1))
        assert isinstance(policy, (DynaPolicy, DynaBoxPolicy))
        reward_function = compiled_reward(self.reward_function, self.observation_space, self.action_space)
        return LocalPlanner(policy, buffer, action_points, settings, reward_function)

    def _plan_settings(self) -> PlanSettings:
        return PlanSettings(
            gamma=self.gamma,
            optimism=float(self.optimism),
            simulated_steps=int(self.simulated_steps),
            learning_rate=self.lr_schedule(self._current_progress_remaining),
            trace_decay=self.trace_schedule(self._current_progress_remaining),
        )

    # --------------------------------------------------------------- learning

    def _learn_from(
        self, new_obs: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        last, truncated = {}, {}
        if dones.any():
            truncated = self._truncated(dones, infos)
            for env in np.flatnonzero(dones).tolist():
                if "terminal_observation" in infos[env]:
                    last[env] = np.asarray(infos[env]["terminal_observation"])
        self.learner.planner.settings = self._plan_settings()
        self.learner.observe(new_obs, rewards, dones, truncated, last)

    def _lay_anew(self, observations: np.ndarray) -> None:
        """Nothing: the planner lays the points, for its model and values as well."""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The greedy action. Exploring is a matter of ``learn``.

        :param observation: one observation, or a batch, observation units
        :param state: has no effect and is returned
        :param episode_start: has no effect
        :param deterministic: has no effect, the policy is deterministic
        :return: action, or a batch of actions, and ``state``
        """
        return self.policy.predict(observation, state, episode_start, deterministic)

    def predict_next(self, observation: np.ndarray, action: np.ndarray | int) -> Prediction:
        """
        What the model expects after a step.

        :param observation: shape obs_shape, observation units
        :param action: an action of the environment
        :return: the expected next observation and reward, and how well they are known
        :raises ValueError: if nothing has been learned yet, or an argument does not fit the spaces
        """
        obs = np.asarray(observation)
        if obs.shape != (self.observation_space.shape or ()):
            raise ValueError(f"observation must have shape {self.observation_space.shape}; got {obs.shape}")
        if not np.isfinite(obs).all():
            raise ValueError(f"observation must be finite; got {obs.tolist()}")
        given = np.asarray(action)
        if given.shape != (self.action_space.shape or ()):
            raise ValueError(f"action must have shape {self.action_space.shape}; got {given.shape}")
        batch = given[None].reshape(1, -1) if isinstance(self.action_space, spaces.Box) else None
        columns = batch if batch is not None else self.policy.columns_of(given[None])[:, 0]
        scaled = self.learner.scaled_actions(columns)[0]
        return self.learner.planner.predict(obs.reshape(-1).astype(np.float64), scaled)

    @property
    def known(self) -> np.ndarray:
        """Whether the model knows what follows on an action at a point, shape (n_points, n_actions), bool."""
        return self.learner.planner.known

    @property
    def visited(self) -> np.ndarray:
        """The observations that the remembered transitions began at, shape (n, obs_dim), observation units."""
        return self.learner.planner.visited

    # ---------------------------------------------------------- learning offline

    def imitate(self: SelfKNNDyna, controller: Any, n_steps: int = 5000, margin: float | None = None) -> SelfKNNDyna:
        """
        Start from a controller: it is run in the environment, and the model is learned from these steps. The policy is
        planned with the model, so it is no copy of the controller.

        :param controller: a function from an observation to an action, an SB3 model or policy, or another object whose
            ``predict`` returns (action, state)
        :param n_steps: number of steps to run it, over all environments
        :param margin: has no effect: the values are planned
        :return: the model
        :raises ValueError: if an argument is invalid, or the controller returns no action of the action space
        """
        transitions = self._run(controller, n_steps)
        self._learn_offline(transitions, 1)
        return self

    def refine(self: SelfKNNDyna, points: Any = None, bounds: Any = None) -> SelfKNNDyna:
        """
        Raises an error: the points of KNNDyna grow by themselves.

        :param points: has no effect
        :param bounds: has no effect
        :raises ValueError: always
        """
        raise ValueError("the points of KNNDyna grow: make a new model with a smaller spacing, and learn_from its data")

    def _learn_offline(self, transitions: Transitions, passes: int) -> None:
        if isinstance(self.action_space, spaces.Discrete):
            transitions = transitions._replace(actions=transitions.actions - int(self.action_space.start))
        else:
            transitions = transitions._replace(actions=transitions.actions.reshape(len(transitions.rewards), -1))
        self.learner.planner.settings = self._plan_settings()
        self.learner.update(transitions, self.lr_schedule(1.0), self.trace_schedule(1.0))
        # The data are in the model: further passes plan.
        for _ in range(passes - 1):
            self.learner.plan(len(transitions.rewards))

    # ---------------------------------------------------------------- logging

    def _log(self) -> dict[str, float]:
        figures = super()._log()
        del figures["train/exploration_rate"]
        return figures

    def learn(
        self: SelfKNNDyna,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "KNNDyna",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfKNNDyna:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
