"""Tile coding: the tile of an observation in each of several offset grids."""

from __future__ import annotations

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.kernels.jit import jit
from sb3_knntd.perception.bounds import Bounds

#: Largest number of weights, a prime. More tiles share them.
MOST_FEATURES = 4_194_301


class TileCoder(nn.Module):
    """
    Several grids over the observation space (Sutton and Barto, 2nd ed., section 9.5.4). Tiling i is offset by the
    fractional part of (1, 3, 5, ...) i / n_tilings tiles in dimensions 0, 1, 2, ...

    Every tile is a feature. If there are more than 4,194,301 features, their indices are taken modulo that prime.
    Observations outside the bounds are clipped to the bounds.

    :param bounds: range of the observations
    :param n_tiles: number of tiles over the range of each dimension, shape (obs_dim,)
    :param n_tilings: number of grids
    """

    n_tiles: th.Tensor
    offsets: th.Tensor

    def __init__(self, bounds: Bounds, n_tiles: np.ndarray, n_tilings: int) -> None:
        super().__init__()
        self.bounds = bounds
        steps = np.outer(np.arange(n_tilings), 2 * np.arange(bounds.obs_dim) + 1)
        self.register_buffer("n_tiles", th.from_numpy(n_tiles.astype(np.int64)))
        self.register_buffer("offsets", th.from_numpy(steps % n_tilings / n_tilings))
        # An offset grid needs one more tile per dimension.
        n_features = n_tilings * int(np.prod(n_tiles.astype(object) + 1))
        #: Number of features.
        self.n_features = min(n_features, MOST_FEATURES)
        # Views of the buffers, because accessing them through torch takes longer than a step.
        self._grids = bounds.low.numpy(), bounds.high.numpy(), self.n_tiles.numpy(), self.offsets.numpy()

    def encode(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: shape (batch, obs_dim), observation units
        :return: indices of the active features, one per tiling, shape (batch, n_tilings)
        """
        features = np.empty((len(observations), len(self._grids[-1])), np.int64)
        active_tiles(np.asarray(observations, np.float64), *self._grids, self.n_features, features)
        return features


@jit
def active_tiles(
    observations: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    n_tiles: np.ndarray,
    offsets: np.ndarray,
    n_features: int,
    features: np.ndarray,
) -> None:
    """
    Fill ``features`` (batch, n_tilings); arguments as in :class:`TileCoder`.

    :param observations: shape (batch, obs_dim)
    :param low: shape (obs_dim,)
    :param high: shape (obs_dim,)
    :param n_tiles: shape (obs_dim,)
    :param offsets: shape (n_tilings, obs_dim), in tiles
    :param n_features: number of features
    :param features: output array
    """
    for row in range(features.shape[0]):
        for tiling in range(features.shape[1]):
            number = tiling
            for dimension in range(observations.shape[1]):
                share = (observations[row, dimension] - low[dimension]) / (high[dimension] - low[dimension])
                place = min(max(share, 0.0), 1.0) * n_tiles[dimension] + offsets[tiling, dimension]
                number = number * (n_tiles[dimension] + 1) + int(place)
            features[row, tiling] = number % n_features
