"""Checks of environments and their spaces."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


def check_environment(algorithm: str, given: Any) -> None:
    """
    :param algorithm: name of the algorithm, for the message
    :param given: value given for the environment
    :raises ValueError: if it is a class of environments, or a name such as ``"envpool:CartPole-v1"``
    """
    if isinstance(given, type) and issubclass(given, (gym.Env, gym.vector.VectorEnv, VecEnv)):
        raise ValueError(
            f"env must be an environment; got the class {given.__name__}. Make an instance: "
            f"{algorithm}({given.__name__}(...))"
        )
    if isinstance(given, str) and given.startswith("envpool:"):
        raise ValueError(
            f"{algorithm}({given!r}) would make gymnasium's environment. For EnvPool's, with 64 environments: "
            f"{algorithm}(EnvPoolVecEnv({given.removeprefix('envpool:')!r}, n_envs=64)), from sb3_knntd.vec_envs"
        )


def check_observation_space(algorithm: str, space: spaces.Space[Any]) -> None:
    """
    :param algorithm: name of the algorithm, for the message
    :param space: the observation space
    :raises ValueError: if it is not a Box of shape (n,), Discrete, or MultiDiscrete or MultiBinary of one axis
    """
    discrete = isinstance(space, spaces.Discrete) or (
        isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary) and len(space.shape or ()) == 1
    )
    vector = isinstance(space, spaces.Box) and len(space.shape) == 1 and space.shape != (0,)
    if discrete or vector:
        return
    if isinstance(space, spaces.Dict | spaces.Tuple):
        advice = "Flatten it with gymnasium.wrappers.FlattenObservation"
    elif isinstance(space, spaces.Box) and len(space.shape) >= 2:
        advice = (
            "Images have too many dimensions for a table of points: extract a few features first, or use a "
            "network (DQN, PPO); small arrays can be flattened with gymnasium.wrappers.FlattenObservation"
        )
    else:
        advice = "Map it to a Box of shape (n,) with gymnasium.wrappers.TransformObservation"
    raise ValueError(
        f"{algorithm} takes observations in a Box of shape (n,), Discrete, or MultiDiscrete or MultiBinary "
        f"of one axis; got {space}. {advice}"
    )


def normalizes_observations(env: GymEnv | None) -> bool:
    """
    :param env: an environment, VecEnv or not
    :return: whether it is wrapped in a VecNormalize that normalises observations
    """
    normalizer = unwrap_vec_normalize(env)  # type: ignore[arg-type]
    return normalizer is not None and normalizer.norm_obs
