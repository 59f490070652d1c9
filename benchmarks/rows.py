"""A row of the table of `python -m benchmarks.speed`."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import NamedTuple


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
