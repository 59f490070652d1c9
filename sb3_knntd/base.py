"""The learning loop that every algorithm here shares, as an SB3 algorithm."""

from __future__ import annotations

import io
import pathlib
import pickle
import sys
import time
import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterable
from math import isfinite
from statistics import fmean
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import is_json_serializable
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule, get_device
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_knntd.actions.selection import ActionRule
from sb3_knntd.common.callback_dispatcher import CallbackDispatcher
from sb3_knntd.common.checks import (
    PROGRESS,
    check_finite,
    check_flag,
    check_integer,
    check_number,
    check_path,
    check_verbose,
    check_word,
    shown,
)
from sb3_knntd.common.files import read_description, replacing
from sb3_knntd.common.plain import encodable, objects_for
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.common.schedules import check_rate, make_schedule, progress_remaining
from sb3_knntd.kernels.step import UNDRAWN
from sb3_knntd.learners.base import Form, Learner, Rates, TorchLearner, check_transition
from sb3_knntd.learners.compiled import CompiledLearner
from sb3_knntd.perception.bounds import steps_to_measure
from sb3_knntd.policies import KNNPolicy
from sb3_knntd.q_table import DenseTable

SelfKNNAlgorithm = TypeVar("SelfKNNAlgorithm", bound="KNNAlgorithm")

NONE_TRUNCATED: dict[int, np.ndarray] = {}
#: What NumPy's global generator takes.
LARGEST_SEED = 2**32 - 1


class KNNAlgorithm(BaseAlgorithm):
    """
    What the algorithms of this package share: spaces, parameters, the learning loop, saving and loading.

    The parameters are those of :class:`~sb3_knntd.KNNTD`.
    """

    policy: KNNPolicy
    learner: Learner
    trace_schedule: Schedule
    exploration_schedule: Schedule
    exploration_initial_eps: float
    exploration_final_eps: float
    exploration_fraction: float

    #: What a saved file calls the algorithm: subclasses read each other's.
    _algorithm: ClassVar[str]
    #: What an action space must be, and what to do with another.
    _supported_action_space: ClassVar[type[spaces.Space[Any]]]
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
        #: Which algorithm a saved file is of.
        self.algorithm = self._algorithm
        self.gamma = gamma
        self.trace_decay = trace_decay
        self.n_neighbors = n_neighbors
        self.points = points
        self.bounds = bounds
        self.weights = weights
        self.bandwidth = bandwidth
        self.search = search
        self.step_size = step_size
        self.traces = traces
        self.reset_other_actions = reset_other_actions
        self.tie_break = tie_break
        self.initial_value = initial_value

        # Where the points lie depends on it.
        self._normalized = normalizes_observations(self.env)
        #: ε or the temperature at the last step
        self.exploration_rate = 0.0
        self._last_actions: np.ndarray | None = None
        # What the last step led to, and while callbacks are told of a step what was acted on in it.
        self._standing: np.ndarray | None = None
        self._acted_on: np.ndarray | None = None
        self._n_measured = 0
        self._measuring = False

    @abstractmethod
    def _make_rule(self) -> ActionRule:
        """Check the parameters of the action rule and make it."""

    def _policy_arguments(self) -> dict[str, Any]:
        """Arguments of the policy besides those that all algorithms have."""
        return {}

    @abstractmethod
    def _make_exploration_schedule(self) -> Schedule:
        """Check the parameters of exploration and make the schedule of its rate."""

    # ----------------------------------------------------------------- set-up

    @classmethod
    def _sort_out(
        cls, policy: str | type[BasePolicy] | GymEnv, env: GymEnv | str | None
    ) -> tuple[type[KNNPolicy], GymEnv | str | None]:
        """Tell policy and environment apart: either order of giving them works."""
        name = next(iter(cls.policy_aliases))
        default: type[KNNPolicy] = cls.policy_aliases[name]  # type: ignore[assignment]
        call = f'{cls.__name__}(env), or in SB3\'s order {cls.__name__}("{name}", env)'
        cls._check_environment(policy)
        cls._check_environment(env)
        if isinstance(policy, str) and policy in cls.policy_aliases:
            policy = cls.policy_aliases[policy]
        if isinstance(policy, str) and policy.endswith("Policy"):
            raise ValueError(
                f"{cls.__name__} has no {policy!r}: its one policy is named {name!r}, as it learns a table and has no "
                f"network to choose. Call {call}"
            )
        if isinstance(policy, type):
            if not (issubclass(policy, default) and policy.acts_in is cls._supported_action_space):
                raise ValueError(
                    f"policy of {cls.__name__} must be {default.__name__} or a subclass with actions in a "
                    f"{cls._supported_action_space.__name__}; got {policy.__name__}. Call {call}"
                )
            return policy, env
        if env is not None:
            raise ValueError(f"two environments were given, {policy!r} and {env!r}. Call {call}")
        return default, policy

    @classmethod
    def _check_environment(cls, given: Any) -> None:
        """Refuse what is near to an environment."""
        if isinstance(given, type) and issubclass(given, (gym.Env, gym.vector.VectorEnv, VecEnv)):
            raise ValueError(
                f"env must be an environment; got the class {given.__name__}. Make one of it: "
                f"{cls.__name__}({given.__name__}(...))"
            )
        if isinstance(given, gym.vector.VectorEnv):
            raise ValueError(
                f"{cls.__name__} takes SB3's VecEnv, and environments of gymnasium.vector are none; got {given!r}. In "
                "place of gymnasium.make_vec use make_vec_env(id, n_envs) of stable_baselines3.common.env_util"
            )

    @classmethod
    def _check_spaces(cls, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        discrete = isinstance(observation_space, spaces.Discrete) or (
            isinstance(observation_space, spaces.MultiDiscrete | spaces.MultiBinary)
            and len(observation_space.shape or ()) == 1
        )
        vector = isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 1
        if not (discrete or (vector and observation_space.shape != (0,))):
            if isinstance(observation_space, spaces.Dict | spaces.Tuple):
                advice = "Flatten it with gymnasium.wrappers.FlattenObservation"
            elif isinstance(observation_space, spaces.Box) and len(observation_space.shape) >= 2:
                advice = (
                    "Images have too many dimensions for a table of points: extract a few features first, or use a "
                    "network (DQN, PPO); small arrays can be flattened with gymnasium.wrappers.FlattenObservation"
                )
            else:
                advice = "Map it to a Box of shape (n,) with gymnasium.wrappers.TransformObservation"
            raise ValueError(
                f"{cls.__name__} takes observations in a Box of shape (n,), Discrete, or MultiDiscrete or MultiBinary "
                f"of one axis; got {observation_space}. {advice}"
            )
        if not isinstance(action_space, cls._supported_action_space):
            raise ValueError(
                f"{cls.__name__} takes actions in a {cls._supported_action_space.__name__} space; got {action_space}. "
                f"{cls._action_space_advice}"
            )

    def _setup_model(self) -> None:
        if not hasattr(self, "observation_space"):
            raise ValueError(f"env must be given to build a model: {type(self).__name__}(env)")
        self._check_parameters()
        self._setup_lr_schedule()
        self.trace_schedule = make_schedule(self.trace_decay)
        # What stays as it is need not be asked for: a call more is felt in steps this short.
        rates = self.learning_rate, self.trace_decay
        self._constant_rates = [rate if isinstance(rate, float) else None for rate in rates]
        self.exploration_schedule = self._make_exploration_schedule()
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
        self._rule = rule = self._make_rule()
        self._stream = RandomStream((self.n_envs, 2, rule.n_uniforms))
        self._prediction_stream = RandomStream((rule.n_uniforms,), purpose=1)
        if self.verbose >= 1:
            print(
                f"Neighbours by search={self.policy.search_name!r} over {self.policy.perceiver.points.n_points} points"
            )
        form = Form(
            self.gamma, self.step_size == "normalized", self.traces == "accumulating", bool(self.reset_other_actions)
        )
        self.learner = self._make_learner(rule, form)
        self._adapts = self.policy.perceiver.bounds.adaptive
        self.set_random_seed(self.seed)

    def _make_learner(self, rule: ActionRule, form: Form) -> Learner:
        perceiver, table = self.policy.perceiver, self.policy.table
        if self.policy.is_compiled:
            return CompiledLearner(perceiver, table, rule, self._stream, self.n_envs, form)
        assert isinstance(table, DenseTable)
        return TorchLearner(perceiver, table, rule, self._stream, self.n_envs, form, one_step=self.trace_decay == 0.0)

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = make_schedule(self.learning_rate)

    def _check_parameters(self) -> None:
        self.learning_rate = check_rate("learning_rate", self.learning_rate, 0.0)  # type: ignore[assignment]
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

        :param env: one of the same spaces, and as many if it is a VecEnv
        :param force_reset: whether ``learn`` starts new episodes
        :raises ValueError: if it is a class or of gymnasium.vector; if its observations are normalised (VecNormalize)
            and those that the model was made for are not, or the other way round; as in SB3, if its spaces differ
        """
        self._check_environment(env)
        self._check_normalization(env)
        super().set_env(env, force_reset)

    def _check_normalization(self, env: GymEnv | None) -> None:
        normalized = normalizes_observations(env)
        if normalized and not self._normalized:
            raise ValueError(
                "env normalises observations (VecNormalize), and the points of this model were laid for observations "
                f"as they are. Make a model with it, {type(self).__name__}(VecNormalize(env)), or leave observations "
                "as they are, VecNormalize(env, norm_obs=False)"
            )
        if self._normalized and not normalized:
            raise ValueError(
                "the points of this model were laid for normalised observations (VecNormalize), and env does not "
                "normalise them. Wrap it with what was known of them: VecNormalize.load(path, env)"
            )

    def _warn_of_overshooting(self) -> None:
        """Of step sizes that carry a value beyond what it is moved towards."""
        highest = max(self.lr_schedule(progress) for progress in PROGRESS)
        # An update removes the share α of the TD error if it is normalised, otherwise α Σp², which is α/k at least.
        most = 1 if self.step_size == "normalized" else self.policy.n_neighbors
        if highest > most:
            warnings.warn(
                f"learning_rate={highest:g} with step_size={self.step_size!r} moves values beyond what they are "
                f"learned from, and they may diverge: give at most {most}",
                stacklevel=4,
            )

    def set_random_seed(self, seed: int | None = None) -> None:
        """
        Seed Python, NumPy, torch, the environment, the action space, and the learner's own numbers.

        :param seed: the seed, from 0 to 2³² - 1; ``None`` leaves all but the learner's own as they are, which start
            anew from the operating system's entropy
        :raises ValueError: if it is no such number
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
        The action the table recommends, ties to the lowest; or, if not deterministic, one from the exploration
        policy at its present rate.

        :param observation: one observation, or a batch, observation units
        :param state: handed back, a table has none
        :param episode_start: has no effect
        :param deterministic: whether to leave out exploration
        :return: action, or a batch of them, and ``state``
        """
        greedy, state = self.policy.predict(observation, state, episode_start, deterministic)
        if deterministic:
            return greedy, state
        rows, probabilities = self.policy.perceived_rows(np.asarray(observation))
        uniforms = th.from_numpy(np.stack([self._prediction_stream.next().copy() for _ in range(len(rows))]))
        uniforms, rate = uniforms.to(rows.device), self.exploration_rate
        nothing = th.full((len(rows), len(self._rule.blocks) - 1), UNDRAWN, device=rows.device)
        held = self._rule.hold(nothing, uniforms, rate, th.zeros(len(rows), device=rows.device))
        choice = self._rule.choose(rows, probabilities, uniforms, rate, held)
        return self.policy.fit_actions(choice.actions.cpu().numpy()).reshape(greedy.shape), state

    # --------------------------------------------------------------- learning

    def learn(
        self: SelfKNNAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "KNN",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfKNNAlgorithm:
        """
        Learn from ``total_timesteps`` steps in the environment, from each in the step that made it.

        If a dimension of the observations has no range (infinite bounds, or VecNormalize), the first 1000
        steps (at least 100 of each environment) act at random to find it. They count, and teach no values.

        :param total_timesteps: number of environment steps, over all environments together
        :param callback: called at every step, after it has been learned from
        :param log_interval: number of episodes between logs, ``None`` for none
        :param tb_log_name: name of the run in TensorBoard
        :param reset_num_timesteps: whether to count steps from 0; if not, training goes on where it was
        :param progress_bar: whether to show a progress bar (tqdm and rich)
        :return: the model
        :raises ValueError: if ``total_timesteps`` is no number, or an environment returns an observation or reward that
            is not finite. The table is untouched by that step
        """
        # As SB3, which takes 1e6 as well, and does nothing for numbers below 1; but NaN would be no steps, unnoticed.
        check_number("total_timesteps", total_timesteps)
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        self._measuring = self._must_measure()
        callback.on_training_start(locals(), globals())
        dispatcher = CallbackDispatcher(callback)
        while self.num_timesteps < total_timesteps:
            if not self._step(dispatcher, log_interval):
                break
        dispatcher.flush(self.num_timesteps)
        self.policy.set_training_mode(False)
        callback.on_training_end()
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
            # The environments are about to be reset, and with them the episodes and the actions chosen in them.
            self._last_actions = None
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if self.learner.table is not self.policy.table:
            raise ValueError(
                "model.policy has been replaced, and what is learned would go to the one that the model was made with. "
                "Leave that one, and have it take over what the other has learned: "
                "model.policy.load_state_dict(other.state_dict()), with the points, bounds and dtype of the other"
            )
        self._standing = self._last_obs  # type: ignore[assignment]
        if total_timesteps > self.num_timesteps:
            self._current_progress_remaining = progress_remaining(self.num_timesteps, total_timesteps)
        return total_timesteps, callback

    def _step(self, dispatcher: CallbackDispatcher, log_interval: int | None) -> bool:
        """
        One step in every environment, and what is learned from it.

        :param dispatcher: calls the callbacks
        :param log_interval: number of episodes between logs
        :return: whether to go on
        """
        env = self.env
        assert env is not None
        for each in dispatcher.every_step:
            each.on_rollout_start()
        last_obs = self._last_obs
        if last_obs is not self._standing:
            # A callback has moved the environments, or has given others, which need a reset if it did not say where.
            self._last_actions = None
            if last_obs is None:
                self._last_obs = last_obs = env.reset()  # type: ignore[assignment]
        actions = self._last_actions
        if actions is None or self._measuring:
            actions = self._random_actions() if self._measuring else self._first_actions()
        actions = self.policy.fit_actions(actions)
        new_obs, rewards, dones, infos = env.step(actions)
        n_before = self.num_timesteps
        self.num_timesteps += env.num_envs
        self._current_progress_remaining = progress_remaining(self.num_timesteps, self._total_timesteps)
        try:
            ended = dones.tolist()
            any_ended = True in ended
            truncated = self._truncated(ended, infos) if any_ended else NONE_TRUNCATED
            if self._measuring:
                self._measure(new_obs, rewards, truncated)  # type: ignore[arg-type]
            else:
                self._last_actions = self.learner.learn(
                    new_obs,  # type: ignore[arg-type]
                    rewards,
                    dones,
                    truncated,
                    self._rates(),
                )
        except (ValueError, FloatingPointError) as error:
            step, self.num_timesteps = self.num_timesteps, n_before
            # What was going on in the environments is lost with this step: to go on is to begin anew.
            self._last_obs = self._last_actions = None
            raise type(error)(f"at step {step}: {error}. The table is as it was before this step") from error
        self._standing = new_obs  # type: ignore[assignment]
        n_logs = 0
        reported = any_ended
        for info in infos:
            if "episode" in info:
                reported = True
        if reported:
            self._update_info_buffer(infos, dones)
        if any_ended:
            before = self._episode_num
            self._episode_num += ended.count(True)
            n_logs = self._episode_num // log_interval - before // log_interval if log_interval else 0

        if self._adapts and not (self._measuring or self.policy.perceiver.sees(new_obs)):  # type: ignore[arg-type]
            self._widen(new_obs)  # type: ignore[arg-type]

        # What is seen is handed on and not copied: SB3's algorithms hold on to what a VecEnv returned as well.
        if dispatcher.callbacks and dispatcher.record_step(new_obs, any_ended):  # type: ignore[arg-type]
            self._acted_on = last_obs  # type: ignore[assignment]
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

    def _move_on(self) -> None:
        """Be where the step led, or where a callback that was told of it says: episodes begin there."""
        if self._last_obs is self._acted_on:
            self._last_obs = self._standing
        else:
            self._last_actions = None

    def _rates(self) -> Rates:
        progress = self._current_progress_remaining
        self.exploration_rate = rate = self.exploration_schedule(progress)
        alpha, trace_decay = self._constant_rates
        if alpha is None:
            alpha = self.lr_schedule(progress)
        if trace_decay is None:
            trace_decay = self.trace_schedule(progress)
        return alpha, trace_decay, rate

    def _first_actions(self) -> np.ndarray:
        """The actions chosen at the start of the episodes."""
        assert isinstance(self._last_obs, np.ndarray)
        self._last_actions = self.learner.begin(self._last_obs, self._rates()[2])
        return self._last_actions

    @staticmethod
    def _truncated(ended: list[bool], infos: list[dict[str, Any]]) -> dict[int, np.ndarray]:
        """The last observations of the episodes that a time limit ended; all that ended must be finite."""
        truncated = {}
        for index, info in enumerate(infos):
            if ended[index] and "terminal_observation" in info:
                last = np.asarray(info["terminal_observation"])
                # Sooner than NumPy with few numbers, which only says where when there is something to say.
                if not all(map(isfinite, last.ravel().tolist())):
                    check_finite("a last observation", last[None], [index])
                if info.get("TimeLimit.truncated", False):
                    truncated[index] = last
        return truncated

    # -------------------------------------------- the range of open dimensions

    def _must_measure(self) -> bool:
        return self._n_measured < steps_to_measure(self.n_envs) and self.policy.perceiver.bounds.is_open

    def _random_actions(self) -> np.ndarray:
        n_actions = self.policy.table.n_actions
        return (self._stream.next()[:, 0, 0] * n_actions).astype(np.int64)

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
        """Take in the last observations, and begin anew from there."""
        self.policy.widen(th.from_numpy(observations).to(self.device))
        self._last_actions = None
        self._tell_range(f"widened at step {self.num_timesteps}")

    def _tell_range(self, how: str) -> None:
        if self.verbose >= 1:
            bounds = self.policy.perceiver.bounds
            ranges = ", ".join(
                f"{dimension}: [{bounds.low[dimension]:.3g}, {bounds.high[dimension]:.3g}]"
                for dimension in bounds.open.nonzero()[:, 0].tolist()
            )
            print(f"Range {how}, by observation dimension: {ranges}")

    # ---------------------------------------------------------------- logging

    def dump_logs(self) -> None:
        """Write the log, under SB3's keys and the learner's own."""
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
        for key, value in self.learner.summary().items():
            record(f"train/{key}", value)
        record("train/learning_rate", self.lr_schedule(self._current_progress_remaining))
        record("train/exploration_rate", self.exploration_rate)
        record("train/visited_points", self.policy.table.n_visited)
        self.logger.dump(step=self.num_timesteps)

    # ------------------------------------------------------ saving and loading

    def _excluded_save_params(self) -> list[str]:
        ours = ["_rule", "_stream", "_prediction_stream", "_standing", "_acted_on"]
        return [*super()._excluded_save_params(), *ours]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "learner"], []

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save everything to a zip file, table, traces, random state and counters. It is written beside the old
        file and renamed, so that whatever interrupts it leaves a whole file.

        :param path: file, with ``.zip`` added if it has no suffix, or file-like object
        :param exclude: attributes to leave out besides SB3's
        :param include: attributes to save although SB3 leaves them out
        """
        self._stream_states = [self._stream.state(), self._prediction_stream.state()]
        shown = self._last_obs, self._last_actions
        if self._acted_on is not None:
            # A callback saves: its file goes on where the next step does.
            self._move_on()
        try:
            if not isinstance(path, (str, pathlib.Path)):
                self._save(path, exclude, include)
                return
            target = pathlib.Path(path)
            if not target.suffix:
                target = target.with_name(f"{target.name}.zip")
            target.parent.mkdir(parents=True, exist_ok=True)
            with replacing(target) as file:
                self._save(file, exclude, include)
        finally:
            self._last_obs, self._last_actions = shown

    def _save(self, file: Any, exclude: Iterable[str] | None, include: Iterable[str] | None) -> None:
        """Save to an open file, and beside what SB3 pickles there the same as data, for :meth:`load` without trust."""
        left_out = {*self._excluded_save_params(), *(exclude or ())} - set(include or ())
        values = {name: value for name, value in vars(self).items() if name not in left_out}
        self.plain = encodable({name: value for name, value in values.items() if not is_json_serializable(value)})
        try:
            super().save(file, exclude, include)
        finally:
            del self.plain

    @classmethod
    def load(
        cls: type[SelfKNNAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "cpu",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trusted: bool = True,
        **kwargs: Any,
    ) -> SelfKNNAlgorithm:
        """
        Load a model from a zip file.

        SB3's format has pickled objects in it, and to read them is to run what the file says: by default a file is
        trusted as a program is. With ``trusted=False`` nothing is unpickled; spaces, schedules of SB3, arrays and
        numbers are read as data, which :meth:`save` has stored beside.

        :param path: file, or file-like object
        :param env: environment to go on with; ``None`` to predict only. Its number may differ from the saved
        :param device: where perception and table are to be
        :param custom_objects: objects to take in place of those in the file
        :param print_system_info: whether to print the system it was saved on
        :param force_reset: whether ``learn`` starts new episodes; ``False`` goes on in the middle of the saved
            ones, for an environment that is in the state it was in
        :param trusted: whether to unpickle what the file holds; ``False`` for files of others
        :param kwargs: attributes to change; with ``seed`` the random numbers begin anew
        :return: the model
        :raises ValueError: if the file is damaged, of another algorithm, or of other spaces than ``env`` has; without
            trust also if it holds functions or other objects that are there only as pickles
        """
        cls._check_environment(env)
        saved = read_description(path)
        if saved.get("algorithm") != cls._algorithm:
            raise ValueError(
                f"{path} holds a model of {saved.get('algorithm', 'another algorithm')}, not of {cls._algorithm}: "
                "load it with its own class"
            )
        if not trusted:
            custom_objects = objects_for(path, saved, custom_objects or {}) | (custom_objects or {})
        try:
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except (RuntimeError, pickle.UnpicklingError, KeyError) as error:  # of a state that does not fit
            # SB3 takes a ValueError for that of an old file of DQN, and looks in vain for an optimizer.
            cause = error.__context__ if isinstance(error, KeyError) and error.__context__ else error
            raise ValueError(f"{path}: {cause}") from cause
        vars(model).pop("plain", None)
        if env is not None:
            model._check_normalization(model.env)
        if model.n_envs != saved["n_envs"]:
            model._last_obs = None
        elif model._last_obs is not None:
            shape = (model.n_envs, *(model.observation_space.shape or ()))
            if getattr(model._last_obs, "shape", None) != shape:
                raise ValueError(f"{path}: the last observations must have shape {shape}; got {model._last_obs!r:.200}")
        if not model.learner.in_episodes:
            model._last_actions = None
        # A seed that is given begins new sequences; without one the saved ones go on.
        if kwargs.get("seed") is None:
            for stream, state in zip((model._stream, model._prediction_stream), model._stream_states, strict=True):
                stream.set_state(state)
        return model


def normalizes_observations(env: GymEnv | None) -> bool:
    """
    :param env: an environment, VecEnv or not
    :return: whether it is in a VecNormalize that changes observations
    """
    normalizer = unwrap_vec_normalize(env)  # type: ignore[arg-type]
    return normalizer is not None and normalizer.norm_obs


def check_device(device: Any) -> th.device:
    """
    :param device: what was given
    :return: the device it means; the CPU for CUDA where there is none, as in SB3
    :raises ValueError: if there is no such device, or it cannot hold a table
    """
    error: Exception | None = None
    if isinstance(device, (str, th.device)):
        try:
            found = get_device(device)
            # Some devices hold no float64, and some nothing at all.
            th.zeros(1, dtype=th.float64, device=found).item()
        except (AssertionError, RuntimeError, TypeError, ValueError) as raised:
            error = raised
        else:
            return found
    raise ValueError(f"device must be 'cpu', 'cuda', 'auto' or another of torch's; got {shown(device)}") from error
