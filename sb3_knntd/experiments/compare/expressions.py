"""Safe reading of configurations: RL Zoo evaluates some entries as Python, here they are parsed as data."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

#: Entries that may be an expression.
EXPRESSIONS = ("normalize", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "monitor_kwargs")
#: Names allowed in expressions, besides classes of ``torch.nn`` such as ``nn.ReLU``.
NAMES: dict[str, Any] = {"HerReplayBuffer": HerReplayBuffer, "RMSpropTFLike": RMSpropTFLike}
#: Entries with names of classes, and the required base classes.
CLASSES: dict[str, type] = {
    "env_wrapper": gym.Wrapper,
    "vec_env_wrapper": VecEnvWrapper,
    "callback": BaseCallback,
    "policy": BasePolicy,
}


def as_data(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: hyperparameters in RL Zoo's format
    :return: a copy with expressions replaced by their values
    :raises ValueError: if an expression contains more than literals, ``dict(...)`` and the names of :data:`NAMES`, or a
        class does not have the required base class
    """
    for entry, root in CLASSES.items():
        for name in _class_names(hyperparams.get(entry)):
            _check_class(entry, name, root)
    values = {name: hyperparams[name] for name in EXPRESSIONS if isinstance(hyperparams.get(name), str)}
    return {**hyperparams, **{name: evaluate(name, expression) for name, expression in values.items()}}


def evaluate(name: str, expression: str) -> Any:
    """
    :param name: name of the entry, for the error message
    :param expression: literals, ``dict(...)`` and allowed names
    :return: its value
    :raises ValueError: if the expression contains anything else
    """
    try:
        return _value(ast.parse(expression.strip(), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError, TypeError) as error:
        raise ValueError(
            f"{name} must be literals, dict(...), nn.CLASS, {' or '.join(NAMES)}; got {expression[:200]!r}"
        ) from error


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=keywords) if all(each.arg for each in keywords):
            return {each.arg: _value(each.value) for each in keywords}
        case ast.Dict(keys=keys, values=values):
            return {_value(key): _value(value) for key, value in zip(keys, values, strict=True) if key is not None}
        case ast.List(elts=items):
            return [_value(item) for item in items]
        case ast.Tuple(elts=items):
            return tuple(_value(item) for item in items)
        case ast.Name(id=name) if name in NAMES:
            return NAMES[name]
        case ast.Attribute(value=ast.Name(id="nn"), attr=name):
            found = getattr(nn, name, None)
            if isinstance(found, type) and issubclass(found, nn.Module):
                return found
    return ast.literal_eval(node)


def _class_names(value: Any) -> Iterator[Any]:
    for item in value if isinstance(value, list) else [value]:
        name = next(iter(item), None) if isinstance(item, dict) else item
        # A name without a dot is a policy alias.
        if isinstance(name, str) and "." in name:
            yield name


def _check_class(entry: str, name: str, root: type) -> None:
    """Check a class that RL Zoo will import and call."""
    module, _, attribute = name.rpartition(".")
    found = None
    # Importing an arbitrary package would run its code.
    if module.partition(".")[0] in sys.modules:
        try:
            found = getattr(importlib.import_module(module), attribute, None)
        except ImportError as error:
            raise ValueError(f"{entry}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, root)):
        raise ValueError(
            f"{entry} must be the name of a {root.__name__} in a package that is imported; got {name!r}. Use "
            "--gym-packages to import packages"
        )
