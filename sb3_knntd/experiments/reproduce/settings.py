"""The settings of the paper's figures, and models made from them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import LinearSchedule

import sb3_knntd.envs  # noqa: F401
from sb3_knntd.base import KNNAlgorithm
from sb3_knntd.registry import ALGORITHMS
from sb3_knntd.vec_envs import CompiledVecEnv

#: Entries of a setting that are not arguments of the algorithm.
OF_THE_EXPERIMENT = ("env", "env_kwargs", "episodes", "filter")

Setting = Mapping[str, Any]


def load_settings(figure: str) -> dict[str, dict[str, Setting]]:
    """
    :param figure: name of a figure
    :return: the settings in ``zoo_configs/paper.yml`` by variant (``"paper"`` or ``"best"``) and algorithm
    """
    import yaml

    settings: dict[str, dict[str, Setting]] = yaml.safe_load(
        files("sb3_knntd.zoo_configs").joinpath("paper.yml").read_text(encoding="utf-8")
    )[figure]
    return settings


def compiled(env: gym.Env[Any, Any]) -> CompiledVecEnv:
    """
    :param env: one of the environments that can be compiled
    :return: a VecEnv of it whose steps are compiled, with SB3's Monitor
    """
    return CompiledVecEnv([lambda: Monitor(env)])


def make_model(
    algorithm: str, setting: Setting, seed: int, wrap: Callable[[gym.Env[Any, Any]], GymEnv]
) -> KNNAlgorithm:
    """
    :param algorithm: name of an algorithm of this package
    :param setting: an entry of ``paper.yml``
    :param seed: seed of the model and its environment
    :param wrap: wraps the environment, or makes a VecEnv of it
    :return: the model, to be trained for :func:`total_steps`
    """
    arguments = {name: value for name, value in setting.items() if name not in OF_THE_EXPERIMENT}
    if isinstance(arguments["points"], Mapping):
        arguments["points"] = np.array(list(itertools.product(*arguments["points"]["grid"])))
    for name in ("learning_rate", "trace_decay"):
        schedule = arguments[name]
        if isinstance(schedule, Mapping):
            share = schedule["steps"] / total_steps(setting)
            arguments[name] = LinearSchedule(schedule["start"], schedule["end"], share)
    env = wrap(gym.make(setting["env"], **setting["env_kwargs"]))
    model: KNNAlgorithm = ALGORITHMS[algorithm].load()(env, seed=seed, **arguments)
    return model


def total_steps(setting: Setting) -> int:
    """
    :param setting: an entry of ``paper.yml``
    :return: number of steps if all episodes reach the time limit
    """
    most = gym.spec(setting["env"]).max_episode_steps
    assert most is not None
    return int(setting["episodes"]) * most
