"""Environments for the tests of comparisons; importing this module registers them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class CorridorEnv(gym.Env[np.ndarray, int]):
    """
    A corridor of ten cells: action 1 moves forward, 0 back, a step costs 1, and the end is terminal.

    :param breaks: whether the twentieth step raises an error
    """

    def __init__(self, breaks: bool = False) -> None:
        self.observation_space = spaces.Box(0.0, 10.0, (1,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.breaks = breaks
        self.n_steps = 0

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(**kwargs)
        self.place = int(self.np_random.integers(5))
        return np.array([self.place], np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        if self.breaks and self.n_steps == 20:
            raise RuntimeError("the corridor <has> fallen in")
        self.place = max(0, self.place + (1 if action == 1 else -1))
        return np.array([self.place], np.float32), -1.0, self.place == 10, False, {}


gym.register("compare/Corridor-v0", CorridorEnv, max_episode_steps=25, reward_threshold=-11.0)
gym.register("compare/Broken-v0", CorridorEnv, max_episode_steps=25, kwargs={"breaks": True})
