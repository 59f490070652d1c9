"""One line of the table that `python -m benchmarks.speed` prints."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import NamedTuple


class Row(NamedTuple):
    """
    :param what: what was compared
    :param ratio: the median ratio
    :param low: the lowest of the repeats
    :param high: the highest of the repeats
    :param target: ``">= x"`` or ``"<= x"``
    :param detail: the two things' own figures
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
        :param ratios: one for each repeat
        :param target: ``">= x"`` or ``"<= x"``
        :param detail: the two things' own figures
        :return: the line with their median and range
        """
        return cls(what, statistics.median(ratios), min(ratios), max(ratios), target, detail)

    @property
    def reached(self) -> bool:
        """Whether the median reaches the target."""
        sign, limit = self.target.split()
        return bool(self.ratio >= float(limit) if sign == ">=" else self.ratio <= float(limit))
