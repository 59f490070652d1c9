"""Deterministic environments with specified episode ends, and a recorder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

# A step may report both; this is a termination, without bootstrapping.
ENDS = {
    "terminated": (True, False),
    "truncated": (False, True),
    "both": (True, True),
    "never": (False, False),
}


class EpisodeEnv(gym.Env[Any, Any]):
    """Counts and ends episodes: episode i has ``lengths[i]`` steps and ends with ``ends[i]``, cyclically."""

    def __init__(self, lengths: Sequence[int] = (9, 14, 6), ends: Sequence[str] = ("terminated", "truncated")) -> None:
        self.lengths = tuple(lengths)
        self.ends = tuple(ends)
        self.episode = -1
        self.elapsed = 0

    def _begin_episode(self) -> None:
        self.episode += 1
        self.elapsed = 0

    def _end_of_step(self) -> tuple[bool, bool]:
        self.elapsed += 1
        if self.elapsed < self.lengths[self.episode % len(self.lengths)]:
            return False, False
        return ENDS[self.ends[self.episode % len(self.ends)]]


class DriftEnv(EpisodeEnv):
    """A point on a hilly line, pushed left, not at all, or right; two dimensions of very different scale.

    :param offset: shifts the initial states, so that several environments differ
    """

    LOW = np.array([-1.0, -0.05])
    HIGH = np.array([0.5, 0.06])

    def __init__(self, offset: float = 0.0, **episodes: Any) -> None:
        super().__init__(**episodes)
        self.offset = offset
        self.observation_space = spaces.Box(np.float32([-3.0, -1.0]), np.float32([3.0, 1.0]), dtype=np.float32)
        self.action_space = spaces.Discrete(3)
        self.x = self.v = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._begin_episode()
        # The golden ratio spreads the initial states without random numbers and without hitting a lattice plane.
        self.x = -0.9 + 1.1 * ((0.6180339887 * (self.episode + 1) + self.offset) % 1.0)
        self.v = 0.0123 * np.sin(1.0 + 2.3 * self.episode + self.offset)
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.v += 0.009 * (int(action) - 1) - 0.0061 * np.cos(3.0 * self.x)
        self.x += self.v
        reward = -1.0 + 0.6 * np.sin(4.0 * self.x) - 4.0 * abs(self.v) + 0.07 * int(action)
        terminated, truncated = self._end_of_step()
        return self._observe(), float(reward), terminated, truncated, {}

    def _observe(self) -> NDArray[np.float32]:
        return np.array([self.x, self.v], dtype=np.float32)


class PushEnv(DriftEnv):
    """The drifting point, pushed by all components of a Box action, each with a different effect."""

    def __init__(
        self,
        shape: tuple[int, ...] = (1,),
        low: Any = -1.0,
        high: Any = 1.0,
        dtype: Any = np.float64,
        unbounded: bool = False,
        **arguments: Any,
    ) -> None:
        super().__init__(**arguments)
        self.action_space = spaces.Box(low, high, shape, dtype=dtype)  # type: ignore[assignment]
        if unbounded:
            self.observation_space = spaces.Box(-np.inf, np.inf, (2,), dtype=np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        pushes = np.asarray(action, dtype=np.float64).ravel() / np.arange(1, np.size(action) + 1)
        self.v += 0.009 * pushes.sum() - 0.0061 * np.cos(3.0 * self.x)
        self.x += self.v
        reward = -1.0 + 0.6 * np.sin(4.0 * self.x) - 4.0 * abs(self.v) - 0.2 * np.sum((pushes - 0.4) ** 2)
        terminated, truncated = self._end_of_step()
        return self._observe(), float(reward), terminated, truncated, {}


class GridEnv(EpisodeEnv):
    """A torus of cells, observed as one number (``discrete``), two (``multi_discrete``) or a ``box`` of ints."""

    MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1))

    def __init__(
        self, kind: str = "discrete", shape: tuple[int, int] = (9, 5), dtype: Any = np.int64, **episodes: Any
    ) -> None:
        super().__init__(**episodes)
        self.kind = kind
        self.shape = shape
        self.cell = (0, 0)
        self.observation_space: spaces.Space[Any]
        if kind == "discrete":
            self.observation_space = spaces.Discrete(shape[0] * shape[1])
        elif kind == "multi_discrete":
            self.observation_space = spaces.MultiDiscrete(list(shape))
        else:
            self.observation_space = spaces.Box(
                np.zeros(2, dtype=dtype), np.array([shape[0] - 1, shape[1] - 1], dtype=dtype), dtype=dtype
            )
        self.action_space = spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._begin_episode()
        self.cell = ((4 * self.episode) % self.shape[0], (2 * self.episode + 1) % self.shape[1])
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        (x, y), (dx, dy) = self.cell, self.MOVES[int(action)]
        self.cell = ((x + dx) % self.shape[0], (y + dy) % self.shape[1])
        reward = -1.0 + 0.37 * np.sin(1.7 * self.cell[0] + 0.9 * self.cell[1]) + 0.01 * int(action)
        terminated, truncated = self._end_of_step()
        return self._observe(), float(reward), terminated, truncated, {}

    def _observe(self) -> Any:
        if self.kind == "discrete":
            return self.cell[0] * self.shape[1] + self.cell[1]
        return np.array(self.cell, dtype=self.observation_space.dtype)


class ScriptedEnv(EpisodeEnv):
    """Returns the given observations in order, independent of the actions; the episode ends with the last one."""

    def __init__(
        self, observations: ArrayLike, rewards: Sequence[float], end: str = "never", n_actions: int = 2
    ) -> None:
        super().__init__(lengths=[len(rewards)], ends=[end])
        self.observations = np.asarray(observations, dtype=np.float64)
        self.rewards = tuple(rewards)
        n_dims = self.observations.shape[1]
        self.observation_space = spaces.Box(-1e3, 1e3, (n_dims,), dtype=np.float64)
        self.action_space = spaces.Discrete(n_actions)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._begin_episode()
        return self.observations[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = self.rewards[self.elapsed]
        terminated, truncated = self._end_of_step()
        return self.observations[self.elapsed], float(reward), terminated, truncated, {}


class StillEnv(ScriptedEnv):
    """An environment for models that are only used for prediction."""

    def __init__(self, n_dims: int, n_actions: int = 3) -> None:
        super().__init__(np.zeros((2, n_dims)), [0.0], end="terminated", n_actions=n_actions)


@dataclass
class VecStep:
    """One step of all environments; ``arrived`` has the true last observations of ended episodes."""

    observations: Any
    actions: Any
    rewards: Any
    arrived: Any
    terminated: Any
    truncated: Any


class RecordingVecEnv(VecEnvWrapper):
    """Records the whole interaction between a learner and its environments."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.steps: list[VecStep] = []
        self._shown: Any = None
        self._taken: Any = None

    def reset(self) -> VecEnvObs:
        observations = self.venv.reset()
        self._shown = np.copy(observations)
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        self._taken = np.copy(actions)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        arrived = np.copy(observations)
        truncated = np.zeros(self.num_envs, dtype=bool)
        for env, info in enumerate(infos):
            if dones[env]:
                arrived[env] = info["terminal_observation"]
                truncated[env] = info.get("TimeLimit.truncated", False)
        terminated = dones & ~truncated
        self.steps.append(VecStep(self._shown, self._taken, np.copy(rewards), arrived, terminated, truncated))
        self._shown = np.copy(observations)
        return observations, rewards, dones, infos
