"""An environment as an actor of a Ray cluster (extra ``[ray]``)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
from ray import cloudpickle
from stable_baselines3.common.env_util import is_wrapped, unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from sb3_knntd.common.files import replace_file


def pack_request(name: str, /, *args: Any, **kwargs: Any) -> bytes:
    """
    :param name: name of a method of :class:`EnvActor`
    :param args: its arguments
    :param kwargs: its keyword arguments
    :return: a request for :meth:`EnvActor.answer`
    """
    return bytes(cloudpickle.dumps((name, args, kwargs)))


class EnvActor:
    """
    An environment in its own process.

    Requests and answers are pickled here, because Ray would return read-only arrays.
    """

    env: gym.Env[Any, Any]

    def __init__(self) -> None:
        self.reset_info: dict[str, Any] = {}

    def answer(self, request: bytes) -> bytes:
        """
        :param request: made by :func:`pack_request`
        :return: the method's return value, pickled
        """
        name, args, kwargs = cloudpickle.loads(request)
        return bytes(cloudpickle.dumps(getattr(self, name)(*args, **kwargs)))

    def begin(self, env_fn: bytes, attributes: Mapping[str, bytes], log: str | None, restarts: int) -> str | None:
        """
        Create the environment.

        :param env_fn: function that creates it, pickled
        :param attributes: attributes to set afterwards, by name, pickled
        :param log: Monitor file of the environment that this one replaces
        :param restarts: number of restarts so far, including this one
        :return: Monitor file of this environment, ``None`` if it has no Monitor
        """
        file = Path(log) if log else None
        before = file.read_bytes() if file and file.exists() else b""
        self.env = _patch_env(cloudpickle.loads(env_fn)())
        if file and before and not file.read_bytes().startswith(before):
            # The new Monitor has overwritten the file. SB3's load_results also reads the renamed copy.
            stem = file.name.removesuffix(Monitor.EXT)
            replace_file(file.with_name(f"{stem}before_restart_{restarts}.{Monitor.EXT}"), before)
        for name, value in attributes.items():
            self.set_attr(name, cloudpickle.loads(value))
        monitor = unwrap_wrapper(self.env, Monitor)
        writer = monitor.results_writer if isinstance(monitor, Monitor) else None
        return writer.file_handler.name if writer else None

    def spaces(self) -> tuple[gym.Space[Any], gym.Space[Any]]:
        """
        :return: observation space and action space
        """
        return self.env.observation_space, self.env.action_space

    def reset(self, seed: int | None, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """
        :param seed: ``None`` to keep the random generator as it is
        :param options: options of the environment
        :return: the first observation and its info
        """
        observation, self.reset_info = self.env.reset(seed=seed, **({"options": options} if options else {}))
        return observation, self.reset_info

    def step(self, action: Any) -> tuple[Any, Any, bool, dict[str, Any], dict[str, Any]]:
        """
        Step the environment, and reset it if the episode has ended.

        :param action: the action
        :return: observation, reward, whether the episode has ended, info, and info of the last reset
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["TimeLimit.truncated"] = truncated and not terminated
        done = terminated or truncated
        if done:
            info["terminal_observation"] = observation
            observation, self.reset_info = self.env.reset()
        return observation, reward, done, info, self.reset_info

    def render(self) -> Any:
        """
        :return: the return value of the environment's ``render``
        """
        return self.env.render()

    def has_attr(self, name: str) -> bool:
        """
        :param name: name of an attribute
        :return: whether the environment or a wrapper has it
        """
        try:
            self.env.get_wrapper_attr(name)
        except AttributeError:
            return False
        return True

    def get_attr(self, name: str) -> Any:
        """
        :param name: name of an attribute of the environment or a wrapper
        :return: its value
        """
        return self.env.get_wrapper_attr(name)

    def set_attr(self, name: str, value: Any) -> None:
        """
        :param name: name of an attribute of the outermost wrapper
        :param value: its new value
        """
        setattr(self.env, name, value)

    def env_method(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """
        :param name: name of a method of the environment or a wrapper
        :param args: its arguments
        :param kwargs: its keyword arguments
        :return: its return value
        """
        return self.env.get_wrapper_attr(name)(*args, **kwargs)

    def is_wrapped(self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]]) -> bool:
        """
        :param wrapper_class: class of a wrapper
        :return: whether the environment has such a wrapper
        """
        return is_wrapped(self.env, wrapper_class)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
