"""Schedules as words, for files and command lines."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.utils import LinearSchedule

#: Arguments of the algorithms that can be schedules.
SCHEDULED = ("learning_rate", "trace_decay", "temperature")


def parse_schedule(name: str, word: str) -> LinearSchedule:
    """
    :param name: name of the argument
    :param word: ``"lin_START"``, which falls to 0 as in RL Zoo, or ``"lin_START_END"``
    :return: the schedule, linear over the whole training
    :raises ValueError: if ``word`` is neither
    """
    try:
        kind, start, *rest = word.split("_")
        (end,) = rest or ["0"]
        if kind != "lin":
            raise ValueError
        return LinearSchedule(float(start), float(end), 1.0)
    except ValueError:
        raise ValueError(
            f"{name} must be a number, 'lin_START' (falls to 0) or 'lin_START_END' (e.g. 'lin_0.5_0.05'); got {word!r}"
        ) from None


def with_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: arguments of an algorithm
    :return: a copy in which schedules are functions; numbers stay
    :raises ValueError: if a word is no schedule
    """
    return hyperparams | {
        name: parse_schedule(name, hyperparams[name]) for name in SCHEDULED if isinstance(hyperparams.get(name), str)
    }
