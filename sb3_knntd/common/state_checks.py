"""Validation of state dicts that are loaded from files. Compiled code does not check array bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th


def checked_tensor(
    state: Any,
    name: str,
    shape: Sequence[int | None],
    dtype: th.dtype | None = None,
    low: float = -np.inf,
    high: float = np.inf,
    finite: bool = True,
) -> th.Tensor:
    """
    :param state: a state dict
    :param name: name of the tensor
    :param shape: required shape, ``None`` for any size
    :param dtype: required type, ``None`` for any floating type
    :param low: lowest value allowed
    :param high: highest value allowed
    :param finite: whether all values must be finite
    :return: the tensor
    :raises ValueError: if it is missing or invalid
    """
    value = entry(state, name)
    if not isinstance(value, th.Tensor) or value.layout != th.strided or value.is_meta:
        raise ValueError(f"{name} must be a tensor; got {str(value)[:100]}")
    sizes = tuple(value.shape)
    if len(sizes) != len(shape) or any(want not in (None, size) for size, want in zip(sizes, shape, strict=True)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must have shape ({wanted}); got {sizes}")
    if value.dtype != dtype if dtype else not value.is_floating_point():
        raise ValueError(f"{name} must be of type {dtype or 'float'}; got {value.dtype}")
    # A tensor with strides of 0 stores few numbers whatever its shape: copying it could fill the memory.
    if value.untyped_storage().nbytes() < value.numel() * value.element_size():
        raise ValueError(f"{name} has shape {sizes}, but stores fewer numbers")
    if value.numel():
        smallest, largest = (float(edge) for edge in value.aminmax())
        # All comparisons with NaN are false.
        if not (low <= smallest and largest <= high) or (finite and not (np.isfinite([smallest, largest]).all())):
            raise ValueError(
                f"{name} must be {'finite and ' if finite else ''}within [{low:g}, {high:g}]; got values "
                f"from {smallest:g} to {largest:g}"
            )
    return value


def checked_points(state: Any, name: str, n_points: int) -> th.Tensor:
    """
    :param state: a state dict
    :param name: name of the tensor
    :param n_points: number of points
    :return: the tensor of point indices
    :raises ValueError: if it is missing or invalid, or an index is out of range or occurs twice
    """
    points = checked_tensor(state, name, (None,), th.int64)
    # Compare as integers: floats cannot represent the largest indices exactly.
    if len(points) and (int(points.min()) < 0 or int(points.max()) >= n_points):
        raise ValueError(f"{name} must be within [0, {n_points - 1}]; got {int(points.min())} to {int(points.max())}")
    if len(points.unique()) < len(points):
        raise ValueError(f"{name} must differ; a point occurs twice")
    return points


def checked_integer(state: Any, name: str, low: int, high: int) -> int:
    """
    :param state: a state dict
    :param name: name of the integer
    :param low: lowest value allowed
    :param high: highest value allowed
    :return: the integer
    :raises ValueError: if it is missing, no integer, or out of range
    """
    value = entry(state, name)
    if type(value) is not int or not low <= value <= high:
        raise ValueError(f"{name} must be an integer within [{low}, {high}]; got {str(value)[:100]}")
    return value


def entry(state: Any, name: str) -> Any:
    """
    :param state: a state dict
    :param name: name of the entry
    :return: the entry
    :raises ValueError: if it is missing
    """
    if not isinstance(state, Mapping) or name not in state:
        raise ValueError(f"there is no {name} in the state {str(state)[:100]}")
    return state[name]
