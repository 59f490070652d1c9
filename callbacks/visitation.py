"""Visit counts and trajectories of the environments."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

#: Number of buffered steps: counting many at once takes a hundredth of the time.
BUFFERED = 1024
#: Maximum length of a trajectory, buffers; the last ones are kept.
MAX_CHUNKS = 10

Extent = tuple[float, float, float, float]


class Visitation:
    """
    Counts how often each cell of a grid over two dimensions is visited by any environment, and keeps the trajectories
    of the last episodes of the first environment.

    :param dims: the two dimensions, of the columns and of the rows
    :param resolution: number of cells in each
    :param n_trajectories: number of trajectories that are kept
    """

    def __init__(self, dims: tuple[int, int], resolution: int, n_trajectories: int) -> None:
        self.dims = dims
        #: visits of each cell, shape (resolution, resolution), rows from bottom up
        self.counts = np.zeros((resolution, resolution), np.int64)
        #: observations of each finished episode with its last one, shape (n_steps, obs_dim), the latest episode last
        self.trajectories: deque[np.ndarray] = deque(maxlen=n_trajectories)
        #: append the observations after each step here, shape (n_envs, obs_dim); :meth:`count` empties it
        self.recent: list[np.ndarray] = []
        self._ends: list[tuple[int, np.ndarray]] = []
        self._trajectory: deque[np.ndarray] = deque(maxlen=MAX_CHUNKS)
        self._extent: Extent | None = None

    @property
    def free(self) -> int:
        """Number of steps that may be appended before :meth:`count` must be called."""
        return BUFFERED - len(self.recent)

    def start(self, observations: np.ndarray) -> None:
        """
        Start a new trajectory at the beginning of training, and drop what an interrupted training left in the buffer.

        :param observations: the current observations, shape (n_envs, obs_dim)
        """
        self.recent.clear()
        self._ends.clear()
        self._trajectory.clear()
        self._trajectory.append(observations[:1])

    def end_trajectory(self, last_observation: np.ndarray) -> None:
        """
        End the trajectory: the first environment's episode ended with the step that was appended last.

        :param last_observation: the last of the episode, shape (obs_dim,)
        """
        self._ends.append((len(self.recent) - 1, last_observation))

    def count(self, extent: Extent) -> None:
        """
        Count the steps in the buffer. If the range has changed, the earlier counts are moved to the new cells first.

        :param extent: (left, right, bottom, top), the range of the grid, observation units
        """
        if self._extent not in (None, extent):
            self._regrid(extent)
        self._extent = extent
        if not self.recent:
            return
        # Like np.stack, in a third of its time.
        observations = np.concatenate(self.recent).reshape(len(self.recent), *self.recent[0].shape)
        self._cut(observations[:, 0])
        places = observations[..., list(self.dims)].reshape(-1, 2)
        self.counts += self._histogram(places, np.ones(len(places), np.int64), extent)
        self.recent.clear()

    def _cut(self, observations: np.ndarray) -> None:
        """Cut the first environment's observations, shape (n_steps, obs_dim), where its episodes ended."""
        start = 0
        for end, last_observation in self._ends:
            self.trajectories.append(
                np.concatenate([*self._trajectory, observations[start:end], last_observation[None]])
            )
            self._trajectory.clear()
            start = end
        self._trajectory.append(observations[start:].copy())
        self._ends.clear()

    def _regrid(self, extent: Extent) -> None:
        assert self._extent is not None
        left, right, bottom, top = self._extent
        middles = (np.arange(len(self.counts)) + 0.5) / len(self.counts)
        across, up = np.meshgrid(left + middles * (right - left), bottom + middles * (top - bottom))
        places = np.stack([across, up], axis=2).reshape(-1, 2)
        self.counts = self._histogram(places, self.counts.reshape(-1), extent)

    def _histogram(self, places: np.ndarray, numbers: np.ndarray, extent: Extent) -> np.ndarray:
        """The sum of ``numbers`` in each cell; places outside the grid are not counted."""
        left, right, bottom, top = extent
        # Most observations are float32, and the float32 nearest to a bound counts as inside.
        places = places.astype(np.float32)
        low, high = np.array([left, bottom], np.float32), np.array([right, top], np.float32)
        inside = ((places >= low) & (places <= high)).all(axis=1)
        resolution = len(self.counts)
        # The upper bound belongs to the last cell.
        cells = np.minimum((places[inside] - low) / (high - low) * resolution, resolution - 1).astype(np.int64)
        counts = np.zeros((resolution, resolution), np.int64)
        np.add.at(counts, (cells[:, 1], cells[:, 0]), numbers[inside])
        return counts


def last_observation(infos: Sequence[dict[str, Any]], observations: np.ndarray) -> np.ndarray:
    """
    :param infos: infos of the step that ended the first environment's episode
    :param observations: the current observations, shape (n_envs, obs_dim)
    :return: the last observation of the episode, shape (obs_dim,)
    """
    return np.asarray(infos[0].get("terminal_observation", observations[0]))
