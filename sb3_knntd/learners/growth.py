"""Growth of the points and the table together."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_knntd.common.interrupts import interrupts_held
from sb3_knntd.perception import GrowingPoints, Perceiver
from sb3_knntd.q_table import GrowingTable, QTable


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
    first = points.n_points
    seen = th.from_numpy(np.asarray(observations, dtype=np.float64)).reshape(-1, points.obs_dim).to(table.values.device)
    with table.lock:
        for observation in seen.split(1):
            indices, squared_distances = perceiver.find(observation)
            if not squared_distances[0, 0] > points.squared_spacing:
                continue
            weights = perceiver.weigh(squared_distances).to(table.values.dtype)
            values = (weights[..., None] * table.rows(indices)).sum(dim=1).clamp(min=table.initial_value)
            with interrupts_held():
                perceiver.add_points(observation.cpu())
                table.add_rows(values)
    return np.arange(first, points.n_points)


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
