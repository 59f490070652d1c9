"""Where the environments have been."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

#: Steps kept before they are counted: counting many at once takes a hundredth of the time.
BUFFERED = 1024
#: Of a longer episode the last so many times that are kept.
LONGEST_ROUTE = 10

Extent = tuple[float, float, float, float]


class Footprints:
    """
    How often steps of any environment led to each cell of two dimensions, and the ways that the last episodes of the
    first environment took.

    :param dims: the two dimensions, of the columns and of the rows
    :param resolution: number of cells in each
    :param n_routes: how many episodes are kept
    """

    def __init__(self, dims: tuple[int, int], resolution: int, n_routes: int) -> None:
        self.dims = dims
        #: visits of each cell, shape (resolution, resolution), rows from bottom up
        self.counts = np.zeros((resolution, resolution), np.int64)
        #: observations of the episodes that have ended, the last one among them, shape (n_steps, obs_dim), latest last
        self.routes: deque[np.ndarray] = deque(maxlen=n_routes)
        #: what the environments showed after each step since :meth:`count`, shape (n_envs, obs_dim); to be appended to
        self.recent: list[np.ndarray] = []
        self._ends: list[tuple[int, np.ndarray]] = []
        self._route: deque[np.ndarray] = deque(maxlen=LONGEST_ROUTE)
        self._extent: Extent | None = None

    @property
    def room(self) -> int:
        """How many steps may be appended before :meth:`count` ought to be called."""
        return BUFFERED - len(self.recent)

    def begin(self, observations: np.ndarray) -> None:
        """
        Training begins, with a new route. What waits to be counted of one that was broken off is forgotten.

        :param observations: where the environments are, shape (n_envs, obs_dim)
        """
        self.recent.clear()
        self._ends.clear()
        self._route.clear()
        self._route.append(observations[:1])

    def end_route(self, last_observation: np.ndarray) -> None:
        """
        The episode of the first environment has ended with the step that was appended last.

        :param last_observation: the last of the episode, shape (obs_dim,)
        """
        self._ends.append((len(self.recent) - 1, last_observation))

    def count(self, extent: Extent) -> None:
        """
        Count what was appended since. If the range has changed, what was counted moves over, cell by cell.

        :param extent: (left, right, bottom, top), the range of the cells
        """
        if self._extent not in (None, extent):
            self._move_to(extent)
        self._extent = extent
        if not self.recent:
            return
        # What np.stack does, in a third of its time.
        observations = np.concatenate(self.recent).reshape(len(self.recent), *self.recent[0].shape)
        self._follow(observations[:, 0])
        places = observations[..., list(self.dims)].reshape(-1, 2)
        self.counts += self._histogram(places, np.ones(len(places), np.int64), extent)
        self.recent.clear()

    def _follow(self, observations: np.ndarray) -> None:
        """Cut the first environment's observations, shape (n_steps, obs_dim), where its episodes ended."""
        start = 0
        for end, last_observation in self._ends:
            self.routes.append(np.concatenate([*self._route, observations[start:end], last_observation[None]]))
            self._route.clear()
            start = end
        self._route.append(observations[start:].copy())
        self._ends.clear()

    def _move_to(self, extent: Extent) -> None:
        assert self._extent is not None
        left, right, bottom, top = self._extent
        middles = (np.arange(len(self.counts)) + 0.5) / len(self.counts)
        across, up = np.meshgrid(left + middles * (right - left), bottom + middles * (top - bottom))
        places = np.stack([across, up], axis=2).reshape(-1, 2)
        self.counts = self._histogram(places, self.counts.reshape(-1), extent)

    def _histogram(self, places: np.ndarray, numbers: np.ndarray, extent: Extent) -> np.ndarray:
        """How many fall into each cell; those at places outside fall into none."""
        left, right, bottom, top = extent
        # As observations mostly are: the float32 next to a bound is not beyond it.
        places = places.astype(np.float32)
        low, high = np.array([left, bottom], np.float32), np.array([right, top], np.float32)
        inside = ((places >= low) & (places <= high)).all(axis=1)
        resolution = len(self.counts)
        # The upper end belongs to the last cell.
        cells = np.minimum((places[inside] - low) / (high - low) * resolution, resolution - 1).astype(np.int64)
        counts = np.zeros((resolution, resolution), np.int64)
        np.add.at(counts, (cells[:, 1], cells[:, 0]), numbers[inside])
        return counts


def last_observation(infos: Sequence[dict[str, Any]], observations: np.ndarray) -> np.ndarray:
    """
    :param infos: of the step that ended the first environment's episode
    :param observations: what the environments show now, shape (n_envs, obs_dim)
    :return: the observation the episode ended with, shape (obs_dim,)
    """
    return np.asarray(infos[0].get("terminal_observation", observations[0]))
