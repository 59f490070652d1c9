"""Names of the columns of the table, and of actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_knntd.plots import Names
from sb3_knntd.policies import KNNPolicy, TableModel


def column_names(policy: KNNPolicy, names: Names) -> tuple[str, ...]:
    """
    :param policy: the policy
    :param names: names of the dimensions and actions
    :return: a name for each column of its table: that of the action, or the action point, of a factored table with the
        dimension that it belongs to
    """
    columns = policy.columns
    if not columns.lists:
        return names.actions
    if len(columns.factors) == 2:
        points = columns.points.tolist()
        return tuple(f"{x[0]:.4g}" if len(x) == 1 else f"({', '.join(f'{a:.4g}' for a in x)})" for x in points)
    pairs = zip(names.actions, columns.lists, strict=True)
    return tuple(f"{name} {point:.4g}" for name, points in pairs for point in points.tolist())


def action_text(model: TableModel, action: Any, names: Names) -> str:
    """
    :param model: the model
    :param action: an action of its environment
    :param names: names of the dimensions and actions
    :return: the name of the action, or the value of each of its dimensions with its name
    """
    space = model.action_space
    if isinstance(space, spaces.Discrete):
        return names.actions[int(action - space.start)]
    numbers = np.asarray(action, dtype=np.float64).reshape(-1)
    return ", ".join(f"{name} = {number:.4g}" for name, number in zip(names.actions, numbers, strict=True))
