"""The learner's random numbers: a sequence whose whole state is a key and a position."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

#: Rows made at a time; drawing one from NumPy costs more than taking it from a block.
ROWS_PER_BLOCK = 1024


class RandomStream:
    """
    Rows of uniform random numbers from the counter-based generator Philox, so that a row is a function of
    the key and its number alone and a saved position is all it takes to go on.

    :param seed: seed, or ``None`` for one from the operating system
    :param shape: shape of a row
    :param purpose: streams of one seed for different purposes have nothing in common
    """

    def __init__(self, seed: int | None, shape: tuple[int, ...], purpose: int = 0) -> None:
        self.shape = shape
        self._key = np.random.SeedSequence(seed, spawn_key=(purpose,)).generate_state(2, np.uint64)
        self._position = 0
        self._rows: Iterator[np.ndarray] = iter(())

    def next(self) -> np.ndarray:
        """
        :return: the next row, numbers in [0, 1), a view that must not be written to
        """
        row = next(self._rows, None)
        if row is None:
            number, done = divmod(self._position, ROWS_PER_BLOCK)
            bits = np.random.Philox(key=self._key, counter=[0, 0, number, 0])
            block = np.random.Generator(bits).random((ROWS_PER_BLOCK, *self.shape))
            self._rows = iter(block[done:])
            row = next(self._rows)
        self._position += 1
        return row

    def state(self) -> dict[str, Any]:
        """
        :return: key and position, plain integers
        """
        return {"key": [int(word) for word in self._key], "position": self._position}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`state` returned
        """
        self._key = np.array(state["key"], dtype=np.uint64)
        self._position = state["position"]
        self._rows = iter(())
