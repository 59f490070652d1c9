"""Random observations with the actions and values of a policy, to test an exported one with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_knntd.common.csv_tables import csv_table
from sb3_knntd.common.files import replace_file
from sb3_knntd.export.frozen import Exportable

#: Number of test vectors.
N_VECTORS = 1000


def write_test_vectors(policy: Exportable, path: Path, n: int = N_VECTORS, seed: int = 0) -> Path:
    """
    Write random observations, the policy's actions and its values there: one row for each, with columns
    ``observation_0, ..., action_0, ..., value_0, ...``. Numbers have as many digits as a double holds.

    :param policy: the policy
    :param path: file to write, CSV
    :param n: number of observations
    :param seed: of the random observations
    :return: the file
    """
    observations = policy.frozen().sample_observations(n, seed)
    actions, _ = policy.predict(observations)
    values = policy.q_values(observations).cpu().numpy()
    parts = {"observation": observations, "action": actions, "value": values}
    columns = {name: np.asarray(part).reshape(n, -1) for name, part in parts.items()}
    header = [f"{name}_{i}" for name, part in columns.items() for i in range(part.shape[1])]
    # As Python's numbers: float64 has more digits than a float32, and the C compiler reads doubles.
    rows = [[x for part in row for x in part] for row in zip(*(_plain(part) for part in columns.values()), strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, csv_table(header, rows))
    return path


def _plain(part: np.ndarray) -> list[list[float]]:
    plain: list[list[float]] = part.tolist()
    return plain
