"""Where the environments have been."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

#: Observations kept before they are counted: counting many at once takes a hundredth of the time.
BUFFERED = 1024
#: An episode is kept from the last so many buffers on.
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
        self._extent: Extent | None = None
        self._route: deque[np.ndarray] = deque(maxlen=LONGEST_ROUTE)
        self._buffer = np.empty((0, 0, 0))
        self._n_buffered = self._route_start = 0

    @property
    def room(self) -> int:
        """How often something can be added before :meth:`count` has to be called."""
        return len(self._buffer) - self._n_buffered

    def begin(self, observations: np.ndarray) -> None:
        """
        Training begins, with a new route. Nothing may wait to be counted.

        :param observations: where the environments are, shape (n_envs, obs_dim)
        """
        n_envs, obs_dim = observations.shape
        self._buffer = np.empty((max(16, BUFFERED // n_envs), n_envs, obs_dim), observations.dtype)
        self._n_buffered = self._route_start = 0
        self._route.clear()
        self._route.append(observations[:1].copy())

    def add(self, observations: np.ndarray) -> None:
        """
        :param observations: what the environments show after a step, shape (n_envs, obs_dim)
        """
        self._buffer[self._n_buffered] = observations
        self._n_buffered += 1

    def end_route(self, last_observation: np.ndarray) -> None:
        """
        The episode of the first environment has ended, and what it shows now has not been added yet.

        :param last_observation: the last of the episode, shape (obs_dim,)
        """
        self._keep_route()
        self.routes.append(np.concatenate([*self._route, last_observation[None]]))
        self._route.clear()

    def count(self, extent: Extent) -> None:
        """
        Count what was added since. If the range is another than before, what was counted in that is dropped.

        :param extent: (left, right, bottom, top), the range of the cells
        """
        if extent != self._extent:
            self.counts[:] = 0
            self._extent = extent
        self._keep_route()
        left, right, bottom, top = extent
        # As observations mostly are: the float32 next to a bound is not beyond it.
        low, high = np.array([left, bottom], np.float32), np.array([right, top], np.float32)
        resolution = len(self.counts)
        places = self._buffer[: self._n_buffered][..., list(self.dims)].reshape(-1, 2).astype(np.float32)
        places = places[((places >= low) & (places <= high)).all(axis=1)]
        # The upper end belongs to the last cell.
        columns, rows = np.minimum((places - low) / (high - low) * resolution, resolution - 1).astype(np.int64).T
        self.counts += np.bincount(rows * resolution + columns, minlength=resolution**2).reshape(self.counts.shape)
        self._n_buffered = self._route_start = 0

    def _keep_route(self) -> None:
        """Take what the buffer has of the episode under way."""
        self._route.append(self._buffer[self._route_start : self._n_buffered, 0].copy())
        self._route_start = self._n_buffered


def last_observation(infos: Sequence[dict[str, Any]], observations: np.ndarray) -> np.ndarray:
    """
    :param infos: of the step that ended the first environment's episode
    :param observations: what the environments show now, shape (n_envs, obs_dim)
    :return: the observation the episode ended with, shape (obs_dim,)
    """
    return np.asarray(infos[0].get("terminal_observation", observations[0]))
