"""The learner's random numbers: a sequence whose complete state is a key and a position."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sb3_knntd.common.state_checks import checked_integer, entry

#: Number of rows in a block, unless they exceed NUMBERS_PER_BLOCK numbers (8 MiB): drawing each row from NumPy takes
#: longer than reading it from a block.
ROWS_PER_BLOCK = 1024
NUMBERS_PER_BLOCK = 2**20


class RandomStream:
    """
    Rows of uniform random numbers from the counter-based generator Philox. A row depends only on the key and its
    position, so a sequence can be continued from a saved position.

    :param shape: shape of a row
    :param purpose: streams with the same seed and different purposes are independent
    """

    def __init__(self, shape: tuple[int, ...], purpose: int = 0) -> None:
        self._purpose = purpose
        n_rows = max(1, min(ROWS_PER_BLOCK, NUMBERS_PER_BLOCK // max(1, math.prod(shape))))
        #: the current block of rows, numbers in [0, 1)
        self.rows = np.empty((n_rows, *shape))
        #: number of rows of the block that have been used, shape (1,), int64; kernels increment it too
        self.taken = np.zeros(1, np.int64)
        self.seed(None)

    def seed(self, seed: int | None) -> None:
        """
        Start a new sequence.

        :param seed: seed, or ``None`` for one from the operating system
        """
        self._key = np.random.SeedSequence(seed, spawn_key=(self._purpose,)).generate_state(2, np.uint64)
        # The first block is drawn on demand: a stream is often seeded several times before it is used.
        self._number = -1
        self.taken[0] = len(self.rows)

    def next(self) -> np.ndarray:
        """
        :return: the next row, a read-only view that is valid until the next call
        """
        if self.taken[0] == len(self.rows):
            self.refill()
        self.taken[0] += 1
        row: np.ndarray = self.rows[self.taken[0] - 1]
        return row

    def refill(self) -> None:
        """Draw the next block, when all rows of the current one have been used."""
        self._fill(self._number + 1)

    def _fill(self, number: int) -> None:
        bits = np.random.Philox(key=self._key, counter=[0, 0, number, 0])
        # In this order, an interruption leaves a block whose rows are all used, so it is drawn again.
        np.random.Generator(bits).random(out=self.rows)
        self._number = number
        self.taken[0] = 0

    def state(self) -> dict[str, Any]:
        """
        :return: key and position, Python integers
        """
        position = self._number * len(self.rows) + int(self.taken[0])
        return {"key": [int(word) for word in self._key], "position": position}

    def set_state(self, state: dict[str, Any]) -> None:
        """
        :param state: the return value of :meth:`state`
        :raises ValueError: if it is invalid
        """
        position = checked_integer(state, "position", 0, 2**62)
        key = entry(state, "key")
        if not isinstance(key, list) or len(key) != 2:
            raise ValueError(f"key must be two integers; got {str(key)[:100]}")
        words = [checked_integer({"a word of key": word}, "a word of key", 0, 2**64 - 1) for word in key]
        self._key = np.array(words, dtype=np.uint64)
        number, taken = divmod(position, len(self.rows))
        self._fill(number)
        self.taken[0] = taken
