"""Reward functions that the user knows, compiled for planning."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_knntd.kernels import jit


def compiled_reward(
    function: Callable[..., float] | None, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> Any:
    """
    Compile a reward function. It takes the observation and the next one, float64 arrays of shape (obs_dim,), and
    between them the action: an array of shape (action_dim,), or an int for Discrete actions.

    :param function: the function, or one that numba has compiled; ``None`` if the reward is learned
    :param observation_space: Box
    :param action_space: Box or Discrete
    :return: a compiled function of three arrays, in which a Discrete action is an array of one number; ``None`` if the
        reward is learned
    :raises ValueError: if numba cannot compile the function, or it does not return a finite number
    """
    if function is None:
        return None
    if not callable(function):
        raise ValueError(
            "reward_function must be a function of (observation, action, next_observation), or None; got "
            f"{function!r:.100}"
        )
    if not jit.AVAILABLE:
        raise ValueError(f"reward_function must be compiled, and numba cannot be used: {jit.REASON}")
    import numba

    inner = function if hasattr(function, "py_func") else numba.njit(function)
    if isinstance(action_space, spaces.Discrete):

        def reward(observation: np.ndarray, action: np.ndarray, next_observation: np.ndarray) -> float:
            return float(inner(observation, int(action[0]), next_observation))

        action = np.array([float(action_space.start)])
    else:

        def reward(observation: np.ndarray, action: np.ndarray, next_observation: np.ndarray) -> float:
            return float(inner(observation, action, next_observation))

        action = np.asarray(action_space.sample(), dtype=np.float64).reshape(-1)
    compiled = numba.njit(nogil=True)(reward)
    observation = np.nan_to_num(np.asarray(observation_space.sample(), dtype=np.float64)).reshape(-1)
    try:
        value = compiled(observation, action, observation)
    except Exception as error:  # numba raises errors of many kinds
        raise ValueError(
            "reward_function cannot be compiled by numba, which takes numbers, NumPy arrays and the math module: "
            f"{type(error).__name__}: {str(error)[:300]}"
        ) from error
    if np.isnan(value):
        raise ValueError(f"reward_function must return a finite number; got {value} for observation {observation}")
    return compiled
