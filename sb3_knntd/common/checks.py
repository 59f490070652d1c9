"""Validation of arguments. Error messages name the argument, the given value and what is valid."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from decimal import Decimal
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Member = TypeVar("Member", bound=Enum)

#: Lower limit of positive numbers that are used as divisors: their squares and quotients stay finite.
LEAST = 1e-100
#: The largest 64-bit integer.
LARGEST_COUNT = 2**63 - 1
#: Limit of memory, in bytes, for a single object.
LARGEST_SIZE = 2**32
#: Longer values are truncated in messages, characters.
LONGEST = 300
#: Values of the remaining progress at which a schedule is checked: at its beginning, middle and end.
PROGRESS = (1.0, 0.5, 0.0)


def shown(value: Any) -> str:
    """
    :param value: any value
    :return: its text for a message, truncated if it is long
    """
    try:
        text = repr(value)
    except ValueError:  # Python refuses to convert integers of thousands of digits
        text = f"{type(value).__name__} of too many digits to show"
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def check_word(name: str, value: Any, words: Iterable[str]) -> None:
    """
    :param name: name of the argument
    :param value: the given value
    :param words: allowed strings
    :raises ValueError: if ``value`` is none of ``words``
    """
    allowed = list(words)
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}; got {shown(value)}")


def check_member(name: str, value: Any, members: Iterable[Member]) -> Member:
    """
    :param name: name of the argument
    :param value: a member of an enumeration, or its name in lower case
    :param members: allowed members
    :return: the member
    :raises ValueError: if ``value`` is none of ``members``
    """
    words = {member.name.lower(): member for member in members}
    word = value.name.lower() if isinstance(value, Enum) else value
    check_word(name, word, words)
    return words[word]


def check_flag(name: str, value: Any) -> bool:
    """
    :param name: name of the argument
    :param value: the given value
    :return: the value as a bool
    :raises ValueError: if ``value`` is neither ``True`` nor ``False``
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False; got {shown(value)}")
    return bool(value)


def check_verbose(value: Any) -> int:
    """
    :param value: value given for ``verbose``
    :return: the value as an int, 1 for ``True``
    :raises ValueError: if it is neither an integer >= 0 nor a bool
    """
    return int(value) if isinstance(value, bool) else check_integer("verbose", value, 0)


def check_number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, above: bool = False
) -> float:
    """
    :param name: name of the argument
    :param value: the given value
    :param low: lowest value allowed, or with ``above`` the value it must exceed
    :param high: highest value allowed
    :param above: whether ``low`` itself is excluded
    :return: the value as a float
    :raises ValueError: if ``value`` is not a finite number within the limits
    """
    try:
        number = float(_real(value))
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) and (number > low if above else number >= low) and number <= high):
        raise ValueError(f"{name} must be a finite number in {_range(low, high, above)}; got {shown(value)}")
    return number


def check_integer(name: str, value: Any, low: int, high: int = LARGEST_COUNT) -> int:
    """
    :param name: name of the argument
    :param value: the given value
    :param low: lowest value allowed
    :param high: highest value allowed
    :return: the value as an int
    :raises ValueError: if ``value`` is not an integer within the limits
    """
    number = _real(value)
    # int() raises for NaN and infinity.
    whole = isinstance(number, int) or (math.isfinite(number) and int(number) == number)
    if not (whole and low <= number <= high):
        wanted = f">= {low}" if high == LARGEST_COUNT else f"from {low} to {high}"
        beyond = " and < 2^63" if number > high == LARGEST_COUNT else ""
        raise ValueError(f"{name} must be an integer {wanted}{beyond}; got {shown(value)}")
    return int(number)


def check_numbers(name: str, value: Any) -> np.ndarray:
    """
    :param name: name of the argument
    :param value: the given value
    :return: the value as an array, float64
    :raises ValueError: if ``value`` cannot be converted to an array of numbers
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be an array of numbers; got {shown(value)}") from error
    # Integers and floats: no strings, no booleans, no complex numbers.
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be an array of numbers; got {shown(value)}")
    return array.astype(np.float64)


def check_finite(what: str, values: np.ndarray, envs: Sequence[int]) -> None:
    """
    :param what: what the values are, for the message
    :param values: one row for each of ``envs``
    :param envs: indices of the environments that returned them
    :raises ValueError: if a value is not finite; the message says where
    """
    finite = np.isfinite(values)
    if not finite.all():
        row, *component = np.argwhere(~finite)[0].tolist()
        where = f" in component {component[0]}" if component else ""
        raise ValueError(f"environment {envs[row]} returned {what} that is not finite{where}: {values[row]}")


def check_schedule(
    name: str, value: float | Callable[[float], float], low: float, high: float = math.inf, *, above: bool = False
) -> float | Callable[[float], float]:
    """
    Check a number, or a function of the remaining progress (from 1 to 0) at its beginning, middle and end.

    :param name: name of the argument
    :param value: number or schedule
    :param low: lowest value allowed, or with ``above`` the value it must exceed
    :param high: highest value allowed
    :param above: whether ``low`` itself is excluded
    :return: the number as a float, or the schedule
    :raises ValueError: if a value is out of range, or the function raises
    """
    if not callable(value):
        return check_number(name, value, low, high, above=above)
    for progress in PROGRESS:
        at = f"{name} at progress_remaining={progress:g}"
        try:
            number = value(progress)
        except Exception as error:
            raise ValueError(
                f"{at} must be a finite number in {_range(low, high, above)}; the schedule raised "
                f"{type(error).__name__}: {error}"
            ) from error
        check_number(at, number, low, high, above=above)
    return value


def check_path(name: str, value: Any) -> Path:
    """
    :param name: name of the argument
    :param value: the given value
    :return: the value as a path
    :raises ValueError: if ``value`` is no path
    """
    if not isinstance(value, (str, os.PathLike)) or "\0" in os.fspath(value):
        raise ValueError(f"{name} must be a path, a str or a pathlib.Path; got {shown(value)}")
    return Path(value)


def check_name(name: str, value: Any) -> str:
    """
    :param name: name of the argument
    :param value: the given value
    :return: the value
    :raises ValueError: if ``value`` cannot be part of a file's name
    """
    if not isinstance(value, str) or any(mark in value for mark in "/\\\0"):
        raise ValueError(f"{name} must be part of a file's name, a str without slashes; got {shown(value)}")
    return value


def check_size(what: str, n_bytes: int, advice: str) -> None:
    """
    Check that an object would fit into memory, before it is created.

    :param what: name of the argument, and the object that needs the memory
    :param n_bytes: size of the object, bytes
    :param advice: what to pass instead
    :raises ValueError: if ``n_bytes`` exceeds :data:`LARGEST_SIZE`
    """
    if n_bytes > LARGEST_SIZE:
        raise ValueError(f"{what} would take {in_bytes(n_bytes)}, more than {in_bytes(LARGEST_SIZE)}: {advice}")


def in_bytes(number: int) -> str:
    """
    :param number: number of bytes
    :return: the same as text, in a suitable unit
    """
    units = ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB")
    power = max(number.bit_length() - 1, 0) // 10
    if power >= len(units):
        # A number of combinations can be too large for a float.
        return f"{Decimal(number):.2e} bytes"
    return f"{number / 1024**power:,.4g} {units[power]}"


def _range(low: float, high: float, above: bool) -> str:
    return f"{'(' if above else '['}{low:g}, {high:g}{']' if math.isfinite(high) else ')'}"


def _real(value: Any) -> Any:
    """The int or float ``value``, unpacked from a 0-d array or tensor; NaN for anything else."""
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        value = value.item()
    return value if isinstance(value, (int, float, np.floating)) and not isinstance(value, bool) else math.nan
