"""True online SARSA(λ) with tile coding, the classical alternative to a nearest-neighbour table."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_knntd.common.checks import check_integer, check_number, check_schedule
from sb3_knntd.experiments.baselines.tile_coding import TileCoder
from sb3_knntd.kernels.jit import jit
from sb3_knntd.online_algorithm import OnlineAlgorithm
from sb3_knntd.perception.bounds import MEASURING_STEPS, make_bounds

#: Traces below this are dropped.
SMALLEST_TRACE = 1e-10


class TilePolicy(BasePolicy):
    """
    A linear policy with one weight per tile and action; the value of an action is the sum of the weights of the active
    tiles.

    :param observation_space: Box of shape (obs_dim,)
    :param action_space: Discrete
    :param n_tiles: tiles over the range of a dimension: one number, or one for each dimension
    :param n_tilings: number of offset grids
    :param bounds: ``None`` for those of the space, or (low, high), arrays of shape (obs_dim,) in observation units
    :param initial_value: initial value of all actions
    :raises ValueError: if an argument is invalid
    """

    action_space: spaces.Discrete
    weights: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Discrete,
        n_tiles: Any = 8,
        n_tilings: int = 8,
        bounds: Any = None,
        initial_value: float = 0.0,
    ) -> None:
        super().__init__(observation_space, action_space)
        check_integer("n_tilings", n_tilings, 1)
        check_number("initial_value", initial_value)
        (obs_dim,) = observation_space.shape
        tiles = [n_tiles] * obs_dim if np.ndim(n_tiles) == 0 else list(n_tiles)
        if len(tiles) != obs_dim:
            raise ValueError(
                f"n_tiles must be one number, or {obs_dim}, one for each observation dimension; got {n_tiles!r}"
            )
        for number in tiles:
            check_integer("n_tiles", number, 1)
        self.coder = TileCoder(make_bounds(bounds, observation_space), np.array(tiles), n_tilings)
        shape = int(action_space.n), self.coder.n_features
        # Zeros use memory only once they are written to.
        weights = th.zeros(shape, dtype=th.float64)
        self.register_buffer("weights", weights + initial_value / n_tilings if initial_value else weights)

    def q_values(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: shape (batch, obs_dim), observation units
        :return: values of the actions, shape (batch, n_actions)
        """
        values: np.ndarray = self.weights.numpy()[:, self.coder.encode(observations)].sum(axis=2).T
        return values

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        return th.from_numpy(self.q_values(observation.numpy()).argmax(axis=1) + int(self.action_space.start))


class Traces(NamedTuple):
    """
    Sparse eligibility traces: a list of the features whose trace is not zero.

    :param slots: position of each feature in the list, counted from 1, or 0 if it is not in the list, shape
        (n_actions * n_features,)
    :param features: the list, shape (n_actions * n_features,), filled from the start
    :param values: traces of the listed features
    :param n_listed: length of the list, shape (1,)
    """

    slots: np.ndarray
    features: np.ndarray
    values: np.ndarray
    n_listed: np.ndarray


class TileSarsa(OnlineAlgorithm):
    """
    True online SARSA(λ) (van Seijen et al., JMLR 17, 2016; Sutton and Barto, 2nd ed., section 12.7) with tile coding,
    ε-greedy, for a single environment with Box observations and Discrete actions.

    Like KNNTD, it measures the range of unbounded dimensions in the first 1000 steps, with random actions. After a
    truncation the target bootstraps from the last observation.

    :param policy: ``"TilePolicy"``
    :param env: environment, or its id
    :param learning_rate: α times n_tilings, the share of the error that one update removes, in [0, 1]; number or
        schedule
    :param gamma: γ, in [0, 1]
    :param trace_decay: λ, in [0, 1]
    :param n_tiles: tiles over the range of a dimension: one number, or one for each dimension
    :param n_tilings: number of offset grids
    :param bounds: ``None`` for those of the space, or (low, high), arrays of shape (obs_dim,) in observation units
    :param initial_value: initial value of all actions
    :param exploration_fraction: share of the training over which ε changes, in (0, 1], as in SB3's DQN
    :param exploration_initial_eps: initial ε, in [0, 1]
    :param exploration_final_eps: final ε, in [0, 1]
    :param policy_kwargs: not used; part of SB3's signature
    :param tensorboard_log: folder of the TensorBoard log, ``None`` for no log
    :param verbose: 0 for no output
    :param seed: seed of exploration, tie breaking and the environment
    :param device: ``"cpu"``
    :param _init_setup_model: whether to build the policy in the constructor
    :raises ValueError: if an argument is invalid, or there are several environments
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TilePolicy": TilePolicy}
    policy: TilePolicy

    def __init__(
        self,
        policy: str | type[TilePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 0.5,
        gamma: float = 0.99,
        trace_decay: float = 0.9,
        n_tiles: Any = 8,
        n_tilings: int = 8,
        bounds: Any = None,
        initial_value: float = 0.0,
        exploration_fraction: float = 1.0,
        exploration_initial_eps: float = 0.1,
        exploration_final_eps: float = 0.0,
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
            learning_rate=learning_rate,
            policy_kwargs=policy_kwargs,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=False,
            seed=seed,
            supported_action_spaces=(spaces.Discrete,),
        )
        self.gamma = check_number("gamma", gamma, 0.0, 1.0)
        self.trace_decay = check_number("trace_decay", trace_decay, 0.0, 1.0)
        self.exploration_schedule = LinearSchedule(
            check_number("exploration_initial_eps", exploration_initial_eps, 0.0, 1.0),
            check_number("exploration_final_eps", exploration_final_eps, 0.0, 1.0),
            check_number("exploration_fraction", exploration_fraction, 0.0, 1.0, above=True),
        )
        check_schedule("learning_rate", learning_rate, 0.0, 1.0)
        self.policy_kwargs |= {
            "n_tiles": n_tiles,
            "n_tilings": n_tilings,
            "bounds": bounds,
            "initial_value": initial_value,
        }
        self._q_old = 0.0
        #: Active features of the last observation; None before the first step of an episode.
        self._last_features: np.ndarray | None = None
        self._last_action = 0
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        space = self.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"TileSarsa takes observations in a Box of shape (n,); got {space}")
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self._random = np.random.default_rng(self.seed)
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space, self.action_space, **self.policy_kwargs
        )
        size = self.policy.weights.numel()
        self._weights = self.policy.weights.numpy()
        self._traces = Traces(np.zeros(size, np.int32), np.zeros(size, np.int64), np.zeros(size), np.zeros(1, np.int64))
        #: Number of initial steps that only measure the range of the observations.
        self._measuring_steps = MEASURING_STEPS if self.policy.coder.bounds.is_open else 0

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_traces", "_weights"]

    def _act(self) -> np.ndarray:
        if self._last_features is None:
            assert isinstance(self._last_obs, np.ndarray)
            self._last_features = self.policy.coder.encode(self._last_obs)[0]
            self._last_action = self._choose(self._last_features)
        assert isinstance(self.action_space, spaces.Discrete)
        return np.array([self._last_action + self.action_space.start])

    def _abandon_episodes(self) -> None:
        # Before the model is set up there is none.
        if self._last_features is not None:
            forget(self._traces.slots, self._traces.features, self._traces.n_listed)
            self._q_old, self._last_features = 0.0, None

    def _choose(self, features: np.ndarray) -> int:
        """ε-greedy with random tie breaking; random while the range of the observations is being measured."""
        measuring = self.num_timesteps < self._measuring_steps
        epsilon = 1.0 if measuring else self.exploration_schedule(self._current_progress_remaining)
        return int(choose(self._weights, features, epsilon, *self._random.random(2)))

    def _learn_from(
        self, new_obs: np.ndarray, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        done = bool(dones[0])
        last_obs = infos[0]["terminal_observation"] if done else new_obs[0]
        if self.num_timesteps <= self._measuring_steps:
            # No updates while the tiles still move.
            self.policy.coder.bounds.measure(th.as_tensor(last_obs, dtype=th.float64)[None])
            self._last_features = None
            return
        features = self.policy.coder.encode(np.asarray(last_obs)[None])[0]
        action = self._choose(features)
        terminated = done and not infos[0].get("TimeLimit.truncated", False)
        assert self._last_features is not None
        n_features = self.policy.coder.n_features
        self._q_old = learn_step(
            self._weights.reshape(-1),
            *self._traces,
            self._last_features + self._last_action * n_features,
            features + action * n_features,
            float(rewards[0]),
            terminated,
            self._q_old,
            self.lr_schedule(self._current_progress_remaining) / len(features),
            self.gamma,
            self.trace_decay,
        )
        if done:
            self._abandon_episodes()
        else:
            self._last_features, self._last_action = features, action


@jit
def choose(weights: np.ndarray, features: np.ndarray, epsilon: float, first: float, second: float) -> int:
    """
    Select an action ε-greedily, with random tie breaking.

    :param weights: shape (n_actions, n_features)
    :param features: active features, shape (n_tilings,)
    :param epsilon: ε
    :param first: random number in [0, 1) that decides whether to explore
    :param second: random number in [0, 1) that selects the random action or breaks ties
    :return: the action, counted from 0
    """
    n_actions = weights.shape[0]
    if first < epsilon:
        return int(second * n_actions)
    values = np.zeros(n_actions)
    for action in range(n_actions):
        for feature in features:
            values[action] += weights[action, feature]
    best = np.flatnonzero(values == values.max())
    return int(best[int(second * len(best))])


@jit
def learn_step(
    weights: np.ndarray,
    slots: np.ndarray,
    listed: np.ndarray,
    values: np.ndarray,
    n_listed: np.ndarray,
    features: np.ndarray,
    next_features: np.ndarray,
    reward: float,
    terminated: bool,
    q_old: float,
    alpha: float,
    gamma: float,
    trace_decay: float,
) -> float:
    """
    One update (Sutton and Barto, 2nd ed., p. 307).

    :param weights: shape (n_actions * n_features,)
    :param slots: as in :class:`Traces`
    :param listed: as in :class:`Traces`, ``features`` there
    :param values: as in :class:`Traces`
    :param n_listed: as in :class:`Traces`
    :param features: x, active features of the last state and action, shape (n_tilings,)
    :param next_features: x', active features of the current state and the selected action
    :param reward: R
    :param terminated: whether the current state is terminal
    :param q_old: return value of the last update, 0 at the start of an episode
    :param alpha: α
    :param gamma: γ
    :param trace_decay: λ
    :return: Q', the value of the current state and action before the update
    """
    q, q_next, trace = 0.0, 0.0, 0.0
    for feature in features:
        q += weights[feature]
        if slots[feature] > 0:
            trace += values[slots[feature] - 1]
    if not terminated:
        for feature in next_features:
            q_next += weights[feature]
    error = reward + gamma * q_next - q

    decay = gamma * trace_decay
    kept = 0
    for slot in range(n_listed[0]):
        feature, value = listed[slot], values[slot] * decay
        if abs(value) >= SMALLEST_TRACE:
            listed[kept], values[kept] = feature, value
            kept += 1
            slots[feature] = kept
        else:
            slots[feature] = 0
    for feature in features:
        if slots[feature] == 0:
            listed[kept], values[kept] = feature, 0.0
            kept += 1
            slots[feature] = kept
        values[slots[feature] - 1] += 1.0 - alpha * decay * trace
    n_listed[0] = kept

    for slot in range(kept):
        weights[listed[slot]] += alpha * (error + q - q_old) * values[slot]
    for feature in features:
        weights[feature] -= alpha * (q - q_old)
    return q_next


@jit
def forget(slots: np.ndarray, listed: np.ndarray, n_listed: np.ndarray) -> None:
    """
    Set all traces to 0.

    :param slots: position of each feature in the list
    :param listed: the features in the list
    :param n_listed: length of the list
    """
    for slot in range(n_listed[0]):
        slots[listed[slot]] = 0
    n_listed[0] = 0
