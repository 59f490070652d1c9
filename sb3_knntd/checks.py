"""Checks of what a user passes in. Each names the argument, the value given and what would do."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any


def check_word(name: str, value: Any, words: Iterable[str]) -> None:
    """
    :param name: name of the argument
    :param value: what was given
    :param words: what is allowed
    :raises ValueError: if ``value`` is none of ``words``
    """
    allowed = list(words)
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}; got {value!r}")


def check_number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, above: bool = False
) -> float:
    """
    :param name: name of the argument
    :param value: what was given
    :param low: lowest value allowed, or with ``above`` the value it must exceed
    :param high: highest value allowed
    :param above: whether ``low`` itself is excluded
    :return: the value as a float
    :raises ValueError: if ``value`` is not a finite number within the limits
    """
    wanted = f"{'(' if above else '['}{low:g}, {high:g}{']' if math.isfinite(high) else ')'}"
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    fits = math.isfinite(number) and (number > low if above else number >= low) and number <= high
    if isinstance(value, (bool, str)) or not fits:
        raise ValueError(f"{name} must be a finite number in {wanted}; got {value!r}")
    return number


def check_integer(name: str, value: Any, low: int) -> int:
    """
    :param name: name of the argument
    :param value: what was given
    :param low: lowest value allowed
    :return: the value as an int
    :raises ValueError: if ``value`` is not an integer of at least ``low``
    """
    try:
        whole = not isinstance(value, (bool, str)) and int(value) == value
    except (TypeError, ValueError, OverflowError):
        whole = False
    if not whole or value < low:
        raise ValueError(f"{name} must be an integer >= {low}; got {value!r}")
    return int(value)


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
    :raises ValueError: if a value is out of range
    """
    if not callable(value):
        return check_number(name, value, low, high, above=above)
    for progress in (1.0, 0.5, 0.0):
        check_number(f"{name} at progress_remaining={progress:g}", value(progress), low, high, above=above)
    return value
