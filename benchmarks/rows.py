"""A row of the table of `python -m benchmarks.speed`, and how it is measured."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple


class Row(NamedTuple):
    """
    The result of a comparison of two measurements.

    :param what: what was compared
    :param ratio: median ratio over the repeats
    :param low: lowest ratio
    :param high: highest ratio
    :param target: required ratio, ``">= x"`` or ``"<= x"``
    :param detail: the absolute results of both measurements
    """

    what: str
    ratio: float
    low: float
    high: float
    target: str
    detail: str

    @classmethod
    def of(cls, what: str, ratios: Sequence[float], target: str, detail: str) -> Row:
        """
        :param what: what was compared
        :param ratios: one ratio per repeat
        :param target: required ratio, ``">= x"`` or ``"<= x"``
        :param detail: the absolute results of both measurements
        :return: the row with their median and range
        """
        return cls(what, statistics.median(ratios), min(ratios), max(ratios), target, detail)

    @property
    def reached(self) -> bool:
        """Whether the median reaches the target."""
        sign, limit = self.target.split()
        return bool(self.ratio >= float(limit) if sign == ">=" else self.ratio <= float(limit))


def compare(
    what: str, target: str, one: Callable[[], float], other: Callable[[], float], repeats: int, unit: str
) -> Row:
    """
    :param what: name of the comparison
    :param target: required ratio ``one / other``
    :param one: the first measurement
    :param other: the second measurement
    :param repeats: number of alternating measurements of both, after one warm-up
    :param unit: unit of the measurements
    """
    one(), other()
    pairs = [(one(), other()) for _ in range(repeats)]
    ratios = [a / b for a, b in pairs]
    a, b = (statistics.median(column) for column in zip(*pairs, strict=True))
    return Row.of(what, ratios, target, f"{a:,.4g} / {b:,.4g} {unit}")


def steps_per_second(work: Callable[[int], Any], n_steps: int) -> float:
    """
    :param work: function that makes a given number of environment steps
    :param n_steps: number of steps
    """
    start = time.perf_counter()
    work(n_steps)
    return n_steps / (time.perf_counter() - start)
