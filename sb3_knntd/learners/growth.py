"""Growth of the points and the table together."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_knntd.common.interrupts import interrupts_held
from sb3_knntd.perception import GrowingPoints, Perceiver
from sb3_knntd.q_table import GrowingTable, QTable

FLOAT32 = np.dtype(np.float32)


def grow(perceiver: Perceiver, table: QTable, observations: np.ndarray) -> np.ndarray:
    """
    Make a point of each observation that lies farther than the spacing from all points, one after the other, as long as
    there is room. Do nothing if the points do not grow.

    A new point takes the values that were read at its place, or the initial value where that is higher: a pessimistic
    table goes on from what it has learned nearby, and with an optimistic one the agent still tries what is new. All
    other points keep their values and traces.

    :param perceiver: finds and weighs the neighbours of an observation
    :param table: the Q-table
    :param observations: shape (batch, *obs_shape), observation units
    :return: the indices of the new points, shape (n,), int64
    """
    points = perceiver.points
    if not isinstance(points, GrowingPoints):
        return np.empty(0, np.int64)
    assert isinstance(table, GrowingTable)
    n_before = points.n_points
    seen = as_rows(observations).reshape(-1, points.obs_dim)
    with table.lock:
        row = perceiver.first_new(seen)
        while row < len(seen):
            indices, probabilities = perceiver.perceive_one(seen[row])
            values = (probabilities[..., None].to(table.values.dtype) * table.rows(indices)).sum(dim=1)
            _add_point(perceiver, table, seen[row : row + 1], values.clamp(min=table.initial_value))
            row = perceiver.first_new(seen, row + 1)
    return np.arange(n_before, points.n_points)


def _add_point(perceiver: Perceiver, table: GrowingTable, place: np.ndarray, values: th.Tensor) -> None:
    """Add one point; on failure, leave all as it was."""
    assert isinstance(perceiver.points, GrowingPoints)
    n_before = perceiver.points.n_points
    with interrupts_held():
        try:
            perceiver.add_points(place)
            table.add_rows(values)
        except BaseException:
            perceiver.points.truncate(n_before)
            perceiver.fit()
            raise


def lay_anew(perceiver: Perceiver, table: QTable, observations: np.ndarray) -> np.ndarray | None:
    """
    Lay points that grow anew: scale the open dimensions by the range visited so far, these observations included; drop
    points that have come nearer than the spacing to another; and, if there are as many as there may be, let the spacing
    grow until there is room. It is due when ``perceiver.sees(observations)`` is false.

    Each remaining point takes the mean of the values of the points nearest to it that were visited. If a point was
    dropped, all traces are, and the learner must start new episodes.

    :param perceiver: finds and weighs the neighbours of an observation
    :param table: the Q-table
    :param observations: shape (batch, *obs_shape), observation units
    :return: the new index of each point, of a dropped one that of the remaining point nearest to it, shape (n_before,),
        int64; ``None`` if all points stay
    """
    assert isinstance(table, GrowingTable)
    before = {name: value.clone() for name, value in perceiver.state_dict().items()}
    with table.lock, interrupts_held():
        try:
            moved = perceiver.lay_anew(th.from_numpy(observations))
            if moved is not None:
                table.merge_rows(moved)
        except BaseException:
            perceiver.load_state_dict(before)
            perceiver.fit()
            raise
    return None if moved is None else moved.cpu().numpy()


def as_rows(observations: np.ndarray) -> np.ndarray:
    """
    :param observations: shape (batch, obs_dim), or (batch,) for Discrete, any number type
    :return: the same, shape (batch, obs_dim), as float32 or float64, so that kernels are compiled for only two types
    """
    if observations.dtype is not FLOAT32:
        observations = observations.astype(np.float64, copy=False)
    return observations if observations.ndim == 2 else observations[:, None]
