"""Base class of KNNTD and ExA: parameters, policy and learner, and the range of unbounded dimensions."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_knntd.actions.selection import ActionSelector
from sb3_knntd.common.checks import (
    PROGRESS,
    check_flag,
    check_integer,
    check_number,
    check_path,
    check_verbose,
    check_word,
    shown,
)
from sb3_knntd.common.devices import check_device
from sb3_knntd.common.environments import check_environment, check_observation_space, normalizes_observations
from sb3_knntd.common.hyperparameters import FixedHyperparameter, Hyperparameter
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.common.schedules import check_rate, constant_of, make_schedule
from sb3_knntd.common.transitions import check_transition
from sb3_knntd.insight import Inspectable
from sb3_knntd.kernels.selection import UNDRAWN
from sb3_knntd.kernels.state import UpdateConfig
from sb3_knntd.learners import CompiledLearner, Learner, Rates, TorchLearner
from sb3_knntd.offline import OfflineLearning
from sb3_knntd.perception.bounds import steps_to_measure
from sb3_knntd.policies import KNNPolicy
from sb3_knntd.q_table import DenseTable

NONE_TRUNCATED: dict[int, np.ndarray] = {}
#: The largest seed of NumPy's global generator.
LARGEST_SEED = 2**32 - 1


class KNNAlgorithm(Inspectable, OfflineLearning):
    """
    Base class of the algorithms of this package: parameters, policy, learner, and measuring of unbounded dimensions.

    The parameters are those of :class:`~sb3_knntd.KNNTD`.
    """

    policy: KNNPolicy
    learner: Learner
    trace_schedule: Schedule
    exploration_schedule: Schedule
    exploration_initial_eps: Any = Hyperparameter()
    exploration_final_eps: Any = Hyperparameter()
    exploration_fraction: Any = Hyperparameter()
    learning_rate: Any = Hyperparameter()
    gamma: Any = Hyperparameter()
    trace_decay: Any = Hyperparameter()
    step_size: Any = Hyperparameter()
    traces: Any = Hyperparameter()
    reset_other_actions: Any = Hyperparameter()
    tie_break: Any = Hyperparameter()
    n_neighbors: Any = FixedHyperparameter()
    points: Any = FixedHyperparameter()
    spacing: Any = FixedHyperparameter()
    max_points: Any = FixedHyperparameter()
    bounds: Any = FixedHyperparameter()
    weights: Any = FixedHyperparameter()
    bandwidth: Any = FixedHyperparameter()
    search: Any = FixedHyperparameter()
    initial_value: Any = FixedHyperparameter()

    _is_set_up = False
    #: a schedule, and its value if that is constant
    _constant_trace: tuple[Any, float | None] = (None, None)
    #: Type of the supported action spaces, and advice for unsupported ones.
    _supported_action_spaces: ClassVar[tuple[type[spaces.Space[Any]], ...]]
    _action_space_advice: ClassVar[str]

    def __init__(
        self,
        policy: str | type[BasePolicy] | GymEnv,
        env: GymEnv | str | None,
        *,
        learning_rate: float | Schedule | str,
        gamma: float,
        trace_decay: float | Schedule | str,
        n_neighbors: int | str,
        points: Any,
        spacing: float | str,
        max_points: int,
        bounds: Any,
        weights: str | Callable[[th.Tensor], Any],
        bandwidth: float,
        search: str,
        step_size: str,
        traces: str,
        reset_other_actions: bool,
        tie_break: str,
        initial_value: float,
        stats_window_size: int,
        tensorboard_log: str | None,
        policy_kwargs: dict[str, Any] | None,
        verbose: int,
        seed: int | None,
        device: th.device | str,
    ) -> None:
        verbose = check_verbose(verbose)
        stats_window_size = check_integer("stats_window_size", stats_window_size, 1)
        if tensorboard_log is not None:
            check_path("tensorboard_log", tensorboard_log)
        device = check_device(device)
        policy_class, env = self._sort_out(policy, env)
        if env is not None:
            env = maybe_make_env(env, verbose)
            self._check_spaces(env.observation_space, env.action_space)
        super().__init__(
            policy_class,
            env,
            learning_rate,  # type: ignore[arg-type]
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        #: Name of the algorithm, for saved files.
        self.algorithm = self._algorithm
        self.gamma = gamma
        self.trace_decay = trace_decay
        self.n_neighbors = n_neighbors
        self.points = points
        self.spacing = spacing
        self.max_points = max_points
        self.bounds = bounds
        self.weights = weights
        self.bandwidth = bandwidth
        self.search = search
        self.step_size = step_size
        self.traces = traces
        self.reset_other_actions = reset_other_actions
        self.tie_break = tie_break
        self.initial_value = initial_value

        # The positions of the points depend on it.
        self._normalized = normalizes_observations(self.env)
        #: ε or the temperature at the last step
        self.exploration_rate = 0.0
        self._n_measured = 0
        self._measuring = False

    @abstractmethod
    def _make_selector(self) -> ActionSelector:
        """Check the parameters of action selection and make the selector."""

    def _policy_arguments(self) -> dict[str, Any]:
        """Arguments of the policy other than those common to all algorithms."""
        return {}

    @abstractmethod
    def _make_exploration_schedule(self) -> Schedule:
        """Check the parameters of exploration and make the schedule of its rate."""

    # ----------------------------------------------------------------- set-up

    @classmethod
    def _sort_out(
        cls, policy: str | type[BasePolicy] | GymEnv, env: GymEnv | str | None
    ) -> tuple[type[KNNPolicy], GymEnv | str | None]:
        """Distinguish policy and environment, which may be passed in either order."""
        name = next(iter(cls.policy_aliases))
        default: type[KNNPolicy] = cls.policy_aliases[name]  # type: ignore[assignment]
        call = f'{cls.__name__}(env), or in SB3\'s order {cls.__name__}("{name}", env)'
        check_environment(cls.__name__, policy)
        check_environment(cls.__name__, env)
        if isinstance(policy, str) and policy in cls.policy_aliases:
            policy = cls.policy_aliases[policy]
        if isinstance(policy, str) and policy.endswith("Policy"):
            raise ValueError(
                f"{cls.__name__} has no {policy!r}: its one policy is named {name!r}, as it learns a table and has no "
                f"network to choose. Call {call}"
            )
        if isinstance(policy, type):
            if not (issubclass(policy, default) and policy.acts_in in cls._supported_action_spaces):
                raise ValueError(
                    f"policy of {cls.__name__} must be {default.__name__} or a subclass with actions in a "
                    f"{cls._action_space_names()}; got {policy.__name__}. Call {call}"
                )
            return policy, env
        if env is not None:
            raise ValueError(f"two environments were given, {policy!r} and {env!r}. Call {call}")
        return default, policy

    @classmethod
    def _action_space_names(cls) -> str:
        return " or ".join(space.__name__ for space in cls._supported_action_spaces)

    @classmethod
    def _check_spaces(cls, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        check_observation_space(cls.__name__, observation_space)
        if not isinstance(action_space, cls._supported_action_spaces):
            raise ValueError(
                f"{cls.__name__} takes actions in a {cls._action_space_names()} space; got {action_space}. "
                f"{cls._action_space_advice}"
            )

    def _setup_model(self) -> None:
        if not hasattr(self, "observation_space"):
            raise ValueError(f"env must be given to build a model: {type(self).__name__}(env)")
        self._is_set_up = False
        self._check_parameters()
        self._make_schedules()
        known = {"dtype", "table", "compiled"}
        if not (isinstance(self.policy_kwargs, dict) and self.policy_kwargs.keys() <= known):
            raise ValueError(
                f"policy_kwargs must be a dict of 'dtype', 'table' and 'compiled'; got {shown(self.policy_kwargs)}"
            )
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            n_neighbors=self.n_neighbors,
            points=self.points,
            spacing=self.spacing,
            max_points=self.max_points,
            bounds=self.bounds,
            weights=self.weights,
            bandwidth=self.bandwidth,
            search=self.search,
            initial_value=self.initial_value,
            bounds_from_space=not self._normalized,
            **self._policy_arguments(),
            **self.policy_kwargs,
        ).to(self.device)
        self._warn_of_overshooting()
        self.policy.selector = selector = self._make_selector()
        self._stream = RandomStream((self.n_envs, 2, selector.n_uniforms))
        self._prediction_stream = RandomStream((selector.n_uniforms,), purpose=1)
        if self.verbose >= 1:
            points = "growing" if self.policy.grows else f"{self.policy.perceiver.points.n_points}"
            print(f"Neighbours by search={self.policy.search_name!r} over {points} points")
        self.learner = self._make_learner()
        self._adapts = self.policy.grows or self.policy.perceiver.bounds.adaptive
        self.set_random_seed(self.seed)
        self._is_set_up = True

    def _make_schedules(self) -> None:
        self._setup_lr_schedule()
        self.trace_schedule = make_schedule(self.trace_decay)
        self.exploration_schedule = self._make_exploration_schedule()

    def _reconfigure(self) -> None:
        self._is_set_up = False
        try:
            self._check_parameters()
            selector = self._make_selector()
            if selector.n_uniforms != self.policy.selector.n_uniforms:
                raise ValueError(
                    "exploration cannot be changed to one that takes another number of random numbers: save the "
                    f"model, and load it with the new one, {type(self).__name__}.load(path, exploration=...)"
                )
            self._make_schedules()
            self.policy.selector = selector
            self.learner.configure(selector, self._update_config())
        finally:
            self._is_set_up = True

    def _make_learner(self) -> Learner:
        policy, config = self.policy, self._update_config()
        if policy.is_compiled:
            return CompiledLearner(
                policy.perceiver, policy.table, policy.selector, self._stream, self.n_envs, config, policy.experience
            )
        assert isinstance(policy.table, DenseTable)
        one_step = self.trace_decay == 0.0
        return TorchLearner(
            policy.perceiver,
            policy.table,
            policy.selector,
            self._stream,
            self.n_envs,
            config,
            policy.experience,
            one_step=one_step,
        )

    def _update_config(self) -> UpdateConfig:
        return UpdateConfig(
            gamma=self.gamma,
            normalized=self.step_size == "normalized",
            accumulating=self.traces == "accumulating",
            reset_other_actions=bool(self.reset_other_actions),
        )

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = make_schedule(self.learning_rate)

    def _check_parameters(self) -> None:
        self.learning_rate = check_rate("learning_rate", self.learning_rate, 0.0)
        self.gamma = check_number("gamma", self.gamma, 0.0, 1.0)
        self.trace_decay = check_rate("trace_decay", self.trace_decay, 0.0, 1.0)
        check_word("step_size", self.step_size, ["paper", "normalized"])
        check_word("traces", self.traces, ["replacing", "accumulating"])
        check_word("tie_break", self.tie_break, ["random", "first"])
        check_flag("reset_other_actions", self.reset_other_actions)

    def _make_epsilon_schedule(self) -> Schedule:
        initial = check_number("exploration_initial_eps", self.exploration_initial_eps, 0.0, 1.0)
        final = check_number("exploration_final_eps", self.exploration_final_eps, 0.0, 1.0)
        fraction = check_number("exploration_fraction", self.exploration_fraction, 0.0, 1.0, above=True)
        return LinearSchedule(initial, final, fraction)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Set the environment to learn from.

        :param env: an environment with the same spaces, or a VecEnv with the same number of environments
        :param force_reset: whether ``learn`` starts new episodes
        :raises ValueError: if it is a class or an environment of gymnasium.vector; if only one of this environment and
            the one that the model was made with normalises observations (VecNormalize); as in SB3, if its spaces differ
        """
        check_environment(type(self).__name__, env)
        self._check_normalization(env)
        super().set_env(env, force_reset)

    def _check_normalization(self, env: GymEnv | None) -> None:
        normalized = normalizes_observations(env)
        if normalized and not self._normalized:
            raise ValueError(
                "env normalises observations (VecNormalize), but the points of this model were placed for unnormalised "
                f"observations. Make a new model, {type(self).__name__}(VecNormalize(env)), or do not normalise "
                "observations, VecNormalize(env, norm_obs=False)"
            )
        if self._normalized and not normalized:
            raise ValueError(
                "the points of this model were placed for normalised observations (VecNormalize), but env does not "
                "normalise them. Wrap it with the saved statistics: VecNormalize.load(path, env)"
            )

    def _warn_of_overshooting(self) -> None:
        """Warn if the learning rate is so large that updates overshoot their targets."""
        highest = max(self.lr_schedule(progress) for progress in PROGRESS)
        # An update removes the share α of the TD error if it is normalised, otherwise α Σp², which is at least α/k.
        most = 1 if self.step_size == "normalized" else self.policy.n_neighbors
        if highest > most:
            warnings.warn(
                f"learning_rate={highest:g} with step_size={self.step_size!r} moves values beyond their targets, and "
                f"they may diverge: use at most {most}",
                stacklevel=4,
            )

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Seed Python, NumPy, torch, the environment, the action space, and the learner's random numbers.

        :param seed: the seed, from 0 to 2³² - 1; ``None`` seeds only the learner's random numbers, from the operating
            system's entropy
        :raises ValueError: if it is out of range
        """
        if seed is not None:
            seed = check_integer("seed", seed, 0, LARGEST_SEED)
        super().set_random_seed(seed)
        self._stream.seed(seed)
        self._prediction_stream.seed(seed)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The greedy action, the lowest one of equal actions; or, if not deterministic, an action of the exploration
        policy at its current rate.

        :param observation: one observation, or a batch, observation units
        :param state: has no effect and is returned
        :param episode_start: has no effect
        :param deterministic: whether to act greedily
        :return: action, or a batch of actions, and ``state``
        """
        greedy, state = self.policy.predict(observation, state, episode_start, deterministic)
        if deterministic:
            return greedy, state
        selector = self.policy.selector
        rows, probabilities = self.policy.perceived_rows(np.asarray(observation))
        uniforms = th.from_numpy(np.stack([self._prediction_stream.next().copy() for _ in range(len(rows))]))
        uniforms, rate = uniforms.to(rows.device), self.exploration_rate
        nothing = th.full((len(rows), selector.n_factors), UNDRAWN, device=rows.device)
        persistent = selector.persist(nothing, uniforms, rate, th.zeros(len(rows), device=rows.device))
        selection = selector.select(rows, probabilities, uniforms, rate, persistent)
        return self.policy.fit_actions(selection.actions.cpu().numpy()).reshape(greedy.shape), state

    # --------------------------------------------------------------- learning

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        answer = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self.learner.table is not self.policy.table:
            raise ValueError(
                "model.policy has been replaced, but the learner updates the policy that the model was made with. Keep "
                "that policy and load the other one's state: model.policy.load_state_dict(other.state_dict()); both "
                "must have the same points, bounds and dtype"
            )
        self._measuring = self._must_measure()
        return answer

    def _act(self) -> np.ndarray:
        if self._measuring:
            return self.policy.fit_actions(self._random_actions())
        learner = self.learner
        # Where the rules have changed, the next action may be forbidden.
        if not learner.in_episodes or learner.rules_version != learner.selector.rules.version:
            assert isinstance(self._last_obs, np.ndarray)
            if self.policy.grows and not self.policy.perceiver.sees(self._last_obs):
                self._lay_anew(self._last_obs)
            learner.begin(self._last_obs, self._rates()[2])
        return self.policy.fit_actions(learner.actions)

    def _learn_from(
        self, new_obs: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        truncated = self._truncated(dones, infos) if True in dones.tolist() else NONE_TRUNCATED
        if self._measuring:
            self._measure(new_obs, rewards, truncated)
            return
        self.learner.step(new_obs, rewards, dones, truncated, self._rates())
        if self._adapts and not self.policy.perceiver.sees(new_obs):
            if self.policy.grows:
                self._lay_anew(new_obs)
            else:
                self._widen(new_obs)

    def _abandon_episodes(self) -> None:
        self.learner.abandon_episodes()

    def _rates(self) -> Rates:
        progress = self._current_progress_remaining
        self.exploration_rate = exploration = self.exploration_schedule(progress)
        if self.trace_schedule is not self._constant_trace[0]:
            self._constant_trace = self.trace_schedule, constant_of(self.trace_schedule)
        # λ hardly ever changes, and a call is noticeable in steps this short.
        trace_decay = self._constant_trace[1]
        if trace_decay is None:
            trace_decay = self.trace_schedule(progress)
        return self.lr_schedule(progress), trace_decay, exploration

    def _truncated(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> dict[int, np.ndarray]:
        """The last observations of truncated episodes, by environment. Those of all ended episodes are checked."""
        assert self._step_check is not None
        truncated = {}
        for env in np.flatnonzero(dones).tolist():
            info = infos[env]
            if "terminal_observation" in info:
                last = np.asarray(info["terminal_observation"])
                self._step_check.last_observation(env, last)
                if info.get("TimeLimit.truncated", False):
                    truncated[env] = last
        return truncated

    # -------------------------------------------- the range of open dimensions

    def _must_measure(self) -> bool:
        return self._n_measured < steps_to_measure(self.n_envs) and self.policy.perceiver.bounds.is_open

    def _random_actions(self) -> np.ndarray:
        uniforms = self._stream.next()[:, 0, :1]
        return self.policy.selector.random_columns(uniforms, self._last_obs)[:, 0]  # type: ignore[arg-type]

    def _measure(self, observations: np.ndarray, rewards: np.ndarray, truncated: dict[int, np.ndarray]) -> None:
        check_transition(observations, rewards)
        if truncated:
            observations = np.concatenate((observations, list(truncated.values())))
        self.policy.perceiver.measure(th.from_numpy(observations).to(self.device))
        self._n_measured += self.n_envs
        self._measuring = self._must_measure()
        if not self._measuring:
            self._tell_range(f"measured over {self._n_measured} random steps")

    def _widen(self, observations: np.ndarray) -> None:
        """Widen the bounds to include the last observations, and restart the learner's episodes there."""
        self.policy.widen(th.from_numpy(observations).to(self.device))
        self._abandon_episodes()
        self._tell_range(f"widened at step {self.num_timesteps}")

    def _lay_anew(self, observations: np.ndarray) -> None:
        """Lay points that grow anew, and restart the learner's episodes if points were dropped."""
        if self.policy.lay_anew(observations) is not None:
            self._abandon_episodes()
        # The nearest point may have been dropped.
        self.policy.grow(observations)

    def _tell_range(self, how: str) -> None:
        if self.verbose >= 1:
            bounds = self.policy.perceiver.bounds
            ranges = ", ".join(
                f"{dimension}: [{bounds.low[dimension]:.3g}, {bounds.high[dimension]:.3g}]"
                for dimension in bounds.open.nonzero()[:, 0].tolist()
            )
            print(f"Range {how}, by observation dimension: {ranges}")

    # ---------------------------------------------------------------- logging

    def _log(self) -> dict[str, float]:
        summary = {f"train/{key}": value for key, value in self.learner.summary().items()}
        if self.policy.grows:
            summary["train/n_points"] = self.policy.perceiver.points.n_points
        return summary | {
            "train/learning_rate": self.lr_schedule(self._current_progress_remaining),
            "train/exploration_rate": self.exploration_rate,
            "train/visited_points": self.policy.table.n_visited,
        }
