"""Medians and intervals over seeds, as numbers and as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

#: Quantiles at the ends of an interval.
LOW, HIGH = 0.1, 0.9


def quantile(values: Iterable[float], share: float) -> float:
    """
    Like :func:`numpy.quantile`, but with infinite values: interpolating between a finite value and infinity gives
    infinity.

    :param values: at least one value; infinity for events that did not occur
    :param share: quantile in [0, 1]
    :return: the quantile, interpolated between the two nearest values
    """
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    below, above = ordered[math.floor(place)], ordered[math.ceil(place)]
    return below if below == above else below + (above - below) * (place - math.floor(place))


def number(value: float) -> str:
    """
    :param value: a number; infinity for an event that did not occur
    :return: the number with at least three digits, or "never"
    """
    if math.isinf(value):
        return "never"
    return f"{value:.0f}" if value == round(value) else f"{value:.3g}" if value < 100 else f"{value:.1f}"


def interval(values: Sequence[float]) -> str:
    """
    :param values: one value per seed; infinity for events that did not occur
    :return: median and interval, such as "29 [3, never]"
    """
    low, median, high = (number(quantile(values, share)) for share in (LOW, 0.5, HIGH))
    return f"{median} [{low}, {high}]"


def seeds_range(seeds: Iterable[int]) -> str:
    """
    :param seeds: consecutive seeds
    :return: text such as "30 seeds (1000 to 1029)"
    """
    known = list(seeds)
    return f"{len(known)} seeds ({known[0]} to {known[-1]})" if len(known) > 1 else f"one seed ({known[0]})"


def yes_no(reached: bool) -> str:
    """
    :param reached: whether a criterion is met
    :return: "yes" or "no"
    """
    return "yes" if reached else "no"
