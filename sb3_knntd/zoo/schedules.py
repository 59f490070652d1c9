"""Schedules as words, for files and command lines."""

from __future__ import annotations

from typing import Any

from sb3_knntd.common.schedules import parse_schedule

#: Arguments of the algorithms that can be schedules.
SCHEDULED = ("learning_rate", "trace_decay", "temperature")


def with_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: arguments of an algorithm
    :return: a copy in which schedules are functions; numbers stay
    :raises ValueError: if a word is no schedule
    """
    return hyperparams | {
        name: parse_schedule(name, hyperparams[name]) for name in SCHEDULED if isinstance(hyperparams.get(name), str)
    }
