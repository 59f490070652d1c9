"""
Convert objects to JSON values and back, as a safe alternative to pickle, which executes code from the file. Supported
are numbers, arrays, spaces, SB3's schedules, and policy classes that are already imported.
"""

from __future__ import annotations

import base64
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

#: Key that marks an encoded object. No key of an ordinary dict begins with it.
MARK = ":plain:"
#: Key of the pickle in SB3's format.
PICKLED = ":serialized:"
#: Kinds of NumPy dtypes that arrays may have.
NUMBERS = "biufc"


def encode(value: Any) -> Any:
    """
    :param value: any object
    :return: a JSON value from which :func:`decode` makes an equal object
    :raises TypeError: if the object can only be pickled
    """
    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value) is list:
        return [encode(item) for item in value]
    if type(value) is dict and all(type(key) is str and not key.startswith(MARK) for key in value):
        return {key: encode(item) for key, item in value.items()}
    if isinstance(value, type):
        return {MARK: "class", "of": [class_name(value)]}
    if isinstance(value, th.dtype):
        return {MARK: "dtype", "of": [str(value).removeprefix("torch.")]}
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in NUMBERS:
        kind = "array" if isinstance(value, np.ndarray) else "number"
        content = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {MARK: kind, "of": [value.dtype.str, list(value.shape), content]}
    for kind, (cls, parts, _) in _KINDS.items():
        if type(value) is cls:
            return {MARK: kind, "of": [encode(part) for part in parts(value)]}
    raise TypeError(f"a {type(value).__name__} has to be pickled")


def decode(value: Any) -> Any:
    """
    :param value: a value that :func:`encode` returned, or an untrusted one
    :return: the object; nothing is executed or imported
    :raises ValueError: if the value is invalid
    """
    if isinstance(value, list):
        return [decode(item) for item in value]
    if not isinstance(value, dict):
        return value
    if MARK not in value:
        return {key: decode(item) for key, item in value.items()}
    kind, parts = value[MARK], value.get("of") or []
    try:
        if kind in _KINDS:
            return _KINDS[kind][2](*(decode(part) for part in parts))
        return _DECODERS[kind](*parts)
    except (
        TypeError,
        ValueError,
        KeyError,
        AttributeError,
        AssertionError,
        OverflowError,
        MemoryError,
        RecursionError,
    ) as error:
        raise ValueError(f"no object can be made of {str(value)[:200]}: {error}") from error


def encodable(values: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param values: objects by name
    :return: the encoded objects, without those that can only be pickled
    """
    codes = {}
    for name, value in values.items():
        try:
            codes[name] = encode(value)
        except TypeError:
            continue
    return codes


def objects_for(path: object, description: Mapping[str, Any], given: Iterable[str] = ()) -> dict[str, Any]:
    """
    The objects that replace the pickled ones in a file of SB3's format.

    :param path: the file, for the message
    :param description: the JSON part of the file; its entry ``plain`` holds the encoded objects
    :param given: names of objects that the caller provides
    :return: the other objects, by name
    :raises ValueError: if the file holds one of them only as a pickle
    """
    plain = description.get("plain")
    codes = plain if isinstance(plain, dict) else {}
    given = set(given)
    objects = {}
    for name, value in description.items():
        if name in given or not (isinstance(value, dict) and PICKLED in value):
            continue
        if name not in codes:
            raise ValueError(
                f"{path}: {name} is pickled, {str(value.get(':type:'))[:100]}, and unpickling executes code from the "
                "file. If you trust its source, pass trusted=True"
            )
        objects[name] = decode(codes[name])
    return objects


def class_name(cls: type) -> str:
    """
    :param cls: a class
    :return: its name, with that of its module, see :func:`loaded_class`
    """
    return f"{cls.__module__}.{cls.__qualname__}"


def loaded_class(name: Any, root: type) -> type:
    """
    Find a class that is already imported. Nothing is imported here.

    :param name: name of the class, with that of its module
    :param root: base class that it must be derived from
    :return: the class; the last one if several have the name
    :raises ValueError: if no such class is imported
    """
    waiting, found = [root], []
    while waiting:
        cls = waiting.pop()
        waiting += type.__subclasses__(cls)
        if class_name(cls) == name:
            found.append(cls)
    if not found:
        raise ValueError(f"there is no {root.__name__} {name}: import its module first")
    return found[0]


def _array(dtype: str, shape: list[int], content: str) -> np.ndarray:
    kind = np.dtype(dtype)
    if kind.kind not in NUMBERS or kind.hasobject:
        raise ValueError(f"{dtype!r} is no type of numbers")
    numbers = np.frombuffer(base64.b64decode(content, validate=True), kind)
    if not all(type(n) is int and n >= 0 for n in shape) or math.prod(shape) != len(numbers):
        raise ValueError(f"there are {len(numbers)} numbers for shape {shape}")
    return numbers.reshape(shape).copy()


def _number(dtype: str, shape: list[int], content: str) -> Any:
    return _array(dtype, shape, content)[()]


def _torch_dtype(name: str) -> th.dtype:
    return {"float32": th.float32, "float64": th.float64}[name]


def _policy_class(name: str) -> type:
    return loaded_class(name, BasePolicy)


def _float_schedule(value: Any) -> FloatSchedule:
    # FloatSchedule accepts any callable.
    if not isinstance(value, ConstantSchedule | LinearSchedule | FloatSchedule | float | int):
        raise ValueError(f"{value!r} is no schedule")
    return FloatSchedule(value)


def _box(low: Any, high: Any, dtype: str) -> spaces.Box:
    return spaces.Box(low, high, dtype=np.dtype(dtype).type)


def _discrete(n: int, start: int, dtype: str) -> spaces.Discrete[Any]:
    kind = np.dtype(dtype)
    # Older versions of gymnasium support only this dtype.
    return spaces.Discrete(n, start=start) if kind == np.int64 else spaces.Discrete(n, start=start, dtype=kind)


def _multi_discrete(nvec: Any, start: Any, dtype: str) -> spaces.MultiDiscrete[Any]:
    return spaces.MultiDiscrete(nvec, dtype=np.dtype(dtype), start=start)


#: By name: the class, a function from an object to the arguments of its constructor, and the constructor.
_KINDS: dict[str, tuple[type, Callable[[Any], Iterable[Any]], Callable[..., Any]]] = {
    "tuple": (tuple, lambda items: items, lambda *items: items),
    "deque": (deque, lambda items: (list(items), items.maxlen), deque),
    "box": (spaces.Box, lambda box: (box.low, box.high, box.dtype.str), _box),
    "discrete": (spaces.Discrete, lambda space: (int(space.n), int(space.start), space.dtype.str), _discrete),
    "multi_discrete": (
        spaces.MultiDiscrete,
        lambda space: (space.nvec, space.start, space.dtype.str),
        _multi_discrete,
    ),
    "multi_binary": (
        spaces.MultiBinary,
        lambda space: (list(space.n) if isinstance(space.n, tuple) else space.n,),
        spaces.MultiBinary,
    ),
    "constant_schedule": (ConstantSchedule, lambda schedule: (schedule.val,), ConstantSchedule),
    "linear_schedule": (
        LinearSchedule,
        lambda schedule: (schedule.start, schedule.end, schedule.end_fraction),
        LinearSchedule,
    ),
    "float_schedule": (FloatSchedule, lambda schedule: (schedule.value_schedule,), _float_schedule),
}
_DECODERS: dict[str, Callable[..., Any]] = {
    "class": _policy_class,
    "dtype": _torch_dtype,
    "array": _array,
    "number": _number,
}
