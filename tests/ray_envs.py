"""Environments that other processes can import: one that records what is done to it, and one that dies."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import ray
from gymnasium import spaces


class ProbeEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    Random walks whose episodes have ``length`` steps, with all that a VecEnv can be asked for.

    :param length: steps of an episode
    :param ends: how they end, ``"terminated"`` or ``"truncated"``
    """

    def __init__(self, length: int = 5, ends: str = "terminated", render_mode: str | None = "rgb_array") -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.length, self.ends, self.render_mode = length, ends, render_mode
        self.knob: Any = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        self.state = self.np_random.normal(size=3)
        return self.state, {"seed": seed, "options": options, "draw": self.np_random.random()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action *= 2  # environments may modify the action array
        self.steps += 1
        self.state = self.state + action + self.np_random.normal(size=3)
        over = self.steps >= self.length
        ends = over and self.ends == "terminated", over and self.ends == "truncated"
        # A number that DummyVecEnv does not round.
        return self.state, float(np.float32(self.state.sum())), *ends, {"steps": self.steps}

    def render(self) -> np.ndarray:
        return np.full((4, 6, 3), self.length, np.uint8)

    def scaled(self, factor: float, name: float = 0.0) -> float:  # also the name of an argument of the wrappers
        return factor * self.length + name

    def unlucky(self) -> None:
        raise ValueError("no luck today")


class SampleEnv(gym.Env[Any, Any]):
    """
    Random observations from a space.

    :param space: the observation space
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space = space
        self.action_space = spaces.Discrete(2)
        self.render_mode = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        sample = self.observation_space.sample()
        return sample, np.float32(1.0), False, bool(action), {"seen": sample}


class MortalEnv(gym.Env[np.ndarray, Any]):
    """
    Counts its steps; its process can die or stop responding.

    :param length: steps per episode
    """

    def __init__(self, length: int = 10) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.render_mode = None
        self.length = length
        self.pid = os.getpid()
        self.node = ray.get_runtime_context().get_node_id()
        self.seeds: list[int | None] = []
        self.steps = 0
        self.knob: Any = "untouched"
        self.dies_at = 0
        self.hangs = False
        self.closed_file: Path | None = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        if self.hangs:
            time.sleep(600)
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.steps = 0
        self.start = self.np_random.uniform(-1, 0)
        return self._observe(), {"pid": self.pid}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        if self.steps == self.dies_at:
            self.die()
        return self._observe(), -1.0, self.steps >= self.length, False, {}

    def die(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def close(self) -> None:
        if self.closed_file:
            self.closed_file.touch()

    def _observe(self) -> np.ndarray:
        return np.array([self.start, self.steps], np.float32)
