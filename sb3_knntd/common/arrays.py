"""Named tuples of NumPy arrays whose first axis grows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import torch as th

from sb3_knntd.common.state_checks import checked_tensor

Arrays = TypeVar("Arrays", bound=tuple[np.ndarray, ...])


def reserve(arrays: Arrays, n_used: int, n_rows: int) -> Arrays:
    """
    :param arrays: named tuple of arrays
    :param n_used: number of rows in use
    :param n_rows: number of rows to have
    :return: the same named tuple with new arrays of ``n_rows`` rows, of which the first ``n_used`` are copied
    """
    grown = {}
    for name, array in arrays._asdict().items():  # type: ignore[attr-defined]
        grown[name] = np.zeros((n_rows, *array.shape[1:]), array.dtype)
        grown[name][:n_used] = array[:n_used]
    replaced: Arrays = arrays._replace(**grown)  # type: ignore[attr-defined]
    return replaced


def saved_arrays(arrays: tuple[np.ndarray, ...], n_used: int) -> dict[str, th.Tensor]:
    """
    :param arrays: named tuple of arrays
    :param n_used: number of rows in use
    :return: copies of the rows in use, by name
    """
    fields: dict[str, np.ndarray] = arrays._asdict()  # type: ignore[attr-defined]
    return {name: th.from_numpy(array[:n_used].copy()) for name, array in fields.items()}


def load_arrays(
    arrays: Arrays, state: Mapping[str, Any], n_used: int, ranges: Mapping[str, tuple[float, float]]
) -> Arrays:
    """
    :param arrays: named tuple of arrays of the right shapes and types, except for the number of rows
    :param state: the return value of :func:`saved_arrays`
    :param n_used: number of rows in use
    :param ranges: lowest and highest value of arrays whose values are indices
    :return: the same named tuple with the arrays of the state
    :raises ValueError: if the state is invalid
    """
    loaded = {}
    for name, array in arrays._asdict().items():  # type: ignore[attr-defined]
        low, high = ranges.get(name, (-np.inf, np.inf))
        dtype = th.from_numpy(array[:0]).dtype
        tensor = checked_tensor(state, name, (n_used, *array.shape[1:]), dtype, low, high, finite=False)
        loaded[name] = tensor.numpy().copy()
    replaced: Arrays = arrays._replace(**loaded)  # type: ignore[attr-defined]
    return replaced
