"""Schedules as strings, for files and command lines."""

from __future__ import annotations

from typing import Any

from sb3_knntd.common.schedules import parse_schedule

#: Arguments of the algorithms that can be schedules.
SCHEDULED = ("learning_rate", "trace_decay", "temperature")


def with_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: arguments of an algorithm
    :return: a copy with schedules as functions; numbers are unchanged
    :raises ValueError: if a string is not a schedule
    """
    return hyperparams | {
        name: parse_schedule(name, hyperparams[name]) for name in SCHEDULED if isinstance(hyperparams.get(name), str)
    }
