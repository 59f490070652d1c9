"""Schedules, and strings that describe them."""

from __future__ import annotations

import math

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_knntd.common.checks import check_schedule

#: Prefix of strings that describe a linear schedule.
LINEAR = "lin_"


def parse_schedule(name: str, word: str) -> LinearSchedule:
    """
    :param name: name of the argument
    :param word: ``"lin_START"`` (falls to 0, as in RL Zoo) or ``"lin_START_END"``
    :return: the schedule, linear over the whole training
    :raises ValueError: if ``word`` is neither
    """
    try:
        kind, start, *rest = word.split("_")
        (end,) = rest or ["0"]
        if f"{kind}_" != LINEAR:
            raise ValueError
        return LinearSchedule(float(start), float(end), 1.0)
    except ValueError:
        raise ValueError(
            f"{name} must be a number, 'lin_START' (falls to 0) or 'lin_START_END' (e.g. 'lin_0.5_0.05'); got {word!r}"
        ) from None


def check_rate(
    name: str, value: float | Schedule | str, low: float, high: float = math.inf, *, above: bool = False
) -> float | Schedule | str:
    """
    Check an argument of :func:`make_schedule`.

    :param name: name of the argument
    :param value: number, schedule, or string such as ``"lin_0.5"``
    :param low: lowest value allowed, or with ``above`` the value it must exceed
    :param high: highest value allowed
    :param above: whether ``low`` itself is excluded
    :return: the number as a float, or the schedule or string
    :raises ValueError: if it is none of these, or a value is out of range
    """
    if isinstance(value, str) and value.startswith(LINEAR):
        check_schedule(name, parse_schedule(name, value), low, high, above=above)
        return value
    return check_schedule(name, value, low, high, above=above)  # type: ignore[arg-type]


def progress_remaining(num_timesteps: int, total_timesteps: int) -> float:
    """
    :param num_timesteps: number of steps so far; with several environments it can exceed the total
    :param total_timesteps: total number of steps
    :return: the remaining fraction, from 1 to 0
    """
    return 1.0 - num_timesteps / total_timesteps if num_timesteps < total_timesteps else 0.0


def make_schedule(value: float | Schedule | str) -> FloatSchedule:
    """
    :param value: return value of :func:`check_rate`
    :return: the schedule
    """
    return FloatSchedule(parse_schedule("schedule", value) if isinstance(value, str) else value)


def constant_of(schedule: Schedule) -> float | None:
    """
    :param schedule: a schedule
    :return: its value if it is one of SB3's that is constant; ``None`` if it may change
    """
    inner = getattr(schedule, "value_schedule", schedule)
    return float(inner.val) if isinstance(inner, ConstantSchedule) else None
