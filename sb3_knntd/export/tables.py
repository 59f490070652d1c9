"""CSV and NPZ: the points and their values, for spreadsheets, NumPy and MATLAB."""

from __future__ import annotations

import io
from itertools import pairwise
from pathlib import Path

import numpy as np

from sb3_knntd.common.csv_tables import csv_table
from sb3_knntd.common.files import replace_file
from sb3_knntd.export.frozen import Exportable, FrozenPolicy


def write_csv(policy: Exportable, path: Path) -> list[Path]:
    """
    Write a line for each point: its place in observation units, the values of the columns there, and its visits, 0 if
    learning has not updated it. Of a hashed table, only the points with a row.

    :param policy: the policy
    :param path: file to write
    :return: the file
    """
    frozen = policy.frozen()
    header = [*(f"observation_{j}" for j in range(frozen.obs_dim)), *column_names(frozen), "visits"]
    parts = (frozen.row_places(), frozen.values, frozen.visits[:, None])
    rows = ([number for part in row for number in part] for row in zip(*(p.tolist() for p in parts), strict=True))
    replace_file(path, csv_table(header, rows))
    return [path]


def write_npz(policy: Exportable, path: Path) -> list[Path]:
    """
    Write what :func:`write_csv` writes, and what it means, as arrays: ``points`` (n_rows, obs_dim), ``values``
    (n_rows, n_columns), ``visits`` (n_rows,), ``actions``, the action of each column, (n_columns,) or
    (n_columns, action_dim), and ``low`` and ``high`` (obs_dim,), the range of the points.

    :param policy: the policy
    :param path: file to write
    :return: the file
    """
    frozen, content = policy.frozen(), io.BytesIO()
    first = frozen.first_action
    actions = frozen.columns.points if first is None else first + np.arange(frozen.n_columns)
    np.savez_compressed(
        content,
        points=frozen.row_places(),
        values=frozen.values,
        visits=frozen.visits,
        actions=actions,
        low=frozen.low,
        high=frozen.high,
    )
    replace_file(path, content.getvalue())
    return [path]


def column_names(frozen: FrozenPolicy) -> list[str]:
    """
    :param frozen: a policy
    :return: names of the columns of its table: ``q_`` and the action, which in a factored table is of one dimension
    """
    first = frozen.first_action
    if first is not None:
        return [f"q_{first + column}" for column in range(frozen.n_columns)]
    ends = frozen.columns.factors.tolist()
    if len(ends) == 2:
        return ["q_" + "_".join(f"{x:g}" for x in action) for action in frozen.columns.points.tolist()]
    # In a factored table each factor is a dimension.
    return [
        f"q_action{dimension}_{action[dimension]:g}"
        for dimension, (start, end) in enumerate(pairwise(ends))
        for action in frozen.columns.points[start:end].tolist()
    ]
