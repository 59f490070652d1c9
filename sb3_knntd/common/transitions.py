"""Validation of the return values of environments, before learning from them."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np

from sb3_knntd.common.checks import check_finite

#: Kinds of NumPy dtypes that numbers may have: booleans, integers and floats.
NUMBERS = "biuf"
#: Kinds of NumPy dtypes that booleans may have.
TRUTHS = "biu"


class StepCheck:
    """
    Checks the arrays that a VecEnv returns. Compiled code does not check their shapes.

    :param n_envs: number of environments
    :param obs_shape: shape of one observation
    """

    def __init__(self, n_envs: int, obs_shape: tuple[int, ...]) -> None:
        self._n_envs = n_envs
        self._obs_shape = obs_shape
        self._observations_shape = (n_envs, *obs_shape)
        self._per_env = (n_envs,)
        self._known_types: tuple[Any, ...] = (None, None, None)

    def reset(self, observations: Any) -> None:
        """
        :param observations: the return value of ``reset``
        :raises ValueError: if it is no array of the right shape
        """
        if getattr(observations, "shape", None) != self._observations_shape or observations.dtype.kind not in NUMBERS:
            self._refuse("reset", "observations", observations, self._observations_shape)

    def step(self, observations: Any, rewards: Any, dones: Any, infos: Any) -> None:
        """
        The arguments are the return values of ``step``.

        :raises ValueError: if one of them is no array of the right shape, or the number of infos is wrong
        """
        try:
            if (
                observations.shape == self._observations_shape
                and rewards.shape == self._per_env
                and dones.shape == self._per_env
                and len(infos) == self._n_envs
            ):
                known = self._known_types
                # Types hardly ever change from one step to the next.
                if observations.dtype is known[0] and rewards.dtype is known[1] and dones.dtype is known[2]:
                    return
                types = observations.dtype, rewards.dtype, dones.dtype
                if types[0].kind in NUMBERS and types[1].kind in NUMBERS and types[2].kind in TRUTHS:
                    self._known_types = types
                    return
        except (AttributeError, TypeError):
            # What is missing an attribute is named below.
            pass
        self._refuse("step", "observations", observations, self._observations_shape)
        self._refuse("step", "rewards", rewards, self._per_env)
        self._refuse("step", "dones", dones, self._per_env, TRUTHS)
        count = len(infos) if hasattr(infos, "__len__") else type(infos).__name__
        raise ValueError(f"the VecEnv's step must return {self._n_envs} infos; got {count}")

    def last_observation(self, env: int, observation: np.ndarray) -> None:
        """
        :param env: index of the environment
        :param observation: its ``terminal_observation``
        :raises ValueError: if its shape or type is wrong, or it is not finite
        """
        if observation.shape != self._obs_shape or observation.dtype.kind not in NUMBERS:
            raise ValueError(
                f"environment {env} returned a terminal observation of shape {observation.shape} and type "
                f"{observation.dtype}; expected numbers of shape {self._obs_shape}"
            )
        # For few numbers this is faster than NumPy, which then finds the position.
        if not all(map(isfinite, observation.ravel().tolist())):
            check_finite("a terminal observation", observation[None], [env])

    @staticmethod
    def _refuse(call: str, what: str, array: Any, shape: tuple[int, ...], kinds: str = NUMBERS) -> None:
        """Raise an error if an array is not as expected; the message says how it differs."""
        if not isinstance(array, np.ndarray):
            got = f"a {type(array).__name__}"
        elif array.shape != shape:
            got = f"shape {array.shape}{_first_odd_row(array, shape)}"
        elif array.dtype.kind not in kinds:
            got = f"type {array.dtype}"
        else:
            return
        wanted = "truth values" if kinds == TRUTHS else "numbers"
        raise ValueError(
            f"the VecEnv's {call} returned {what} of {got}; expected an array of {wanted} of shape {shape}, a row for "
            f"each of its {shape[0]} environments"
        )


def _first_odd_row(array: np.ndarray, shape: tuple[int, ...]) -> str:
    """The first environment without a row, or whose row is wrong, as text."""
    if array.ndim and array.shape[0] < shape[0]:
        return f", without one for environment {array.shape[0]}"
    if array.ndim and array.shape[1:] != shape[1:]:
        return ", wrong from environment 0 on"
    return ""


def check_transition(observations: np.ndarray, rewards: np.ndarray) -> None:
    """
    :param observations: a row for each environment
    :param rewards: one for each environment
    :raises ValueError: if an observation or reward is not finite; the message says where
    """
    check_finite("an observation", observations, range(len(rewards)))
    check_finite("a reward", rewards, range(len(rewards)))
