"""TorchScript and torch.export: programs that torch runs without this package."""

from __future__ import annotations

import copy
import io
import warnings
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch as th
from torch import nn

from sb3_knntd.common.files import replace_file
from sb3_knntd.export.frozen import Exportable, FrozenPolicy


class ReadTable(nn.Module):
    """
    A table that is only read, with operations that torch can trace, whatever kind of table it is a copy of.

    :param frozen: the policy whose table it copies
    """

    values: th.Tensor
    row_points: th.Tensor | None

    def __init__(self, frozen: FrozenPolicy) -> None:
        super().__init__()
        values, row_points = frozen.stored()
        self.n_rows = len(values)
        if row_points is not None:
            other = np.full((1, frozen.n_columns), frozen.initial_value, values.dtype)
            values = np.concatenate((values, other))
        self.register_buffer("values", th.from_numpy(values))
        self.register_buffer("row_points", None if row_points is None else th.from_numpy(row_points))

    def rows(self, indices: th.Tensor) -> th.Tensor:
        """
        :param indices: points, shape (batch, k), int64
        :return: their values, shape (batch, k, n_columns)
        """
        if self.row_points is None:
            # Where there are fewer points than neighbours, the others have no row, and no weight.
            return self.values[indices.clamp(max=self.n_rows - 1)]
        row = th.searchsorted(self.row_points, indices).clamp(max=self.n_rows - 1)
        return self.values[th.where(self.row_points[row] == indices, row, self.n_rows)]


def write_torchscript(policy: Exportable, path: Path) -> list[Path]:
    """
    Write a program for ``torch.jit.load``, in Python and C++. It takes a batch of observations and returns actions,
    both in the shape and dtype of the spaces.

    :param policy: the policy
    :param path: file to write
    :return: the file
    :raises ValueError: if the weights are a function of other than torch operations
    """
    module, example = _readable(policy)
    content = io.BytesIO()
    with warnings.catch_warnings():
        # torch advises torch.export instead: that is the other format.
        warnings.simplefilter("ignore", DeprecationWarning)
        th.jit.save(th.jit.trace(module, example), content)
    replace_file(path, content.getvalue())
    return [path]


def write_torch_export(policy: Exportable, path: Path) -> list[Path]:
    """
    Write a program for ``torch.export.load``. It takes a batch of observations and returns actions, both in the shape
    and dtype of the spaces.

    :param policy: the policy
    :param path: file to write
    :return: the file
    :raises ValueError: if the weights are a function of other than torch operations
    """
    module, example = _readable(policy)
    content = io.BytesIO()
    program = th.export.export(module, (example,), dynamic_shapes=({0: th.export.Dim("batch", min=1)},))
    th.export.save(program, content)
    replace_file(path, content.getvalue())
    return [path]


def _readable(policy: Exportable) -> tuple[nn.Module, th.Tensor]:
    """The policy with a table that can be traced, and a batch of observations."""
    module = copy.copy(cast(Any, policy))
    table = ReadTable(policy.frozen()).to(module.device)
    module._modules = {**module._modules, "table": table}
    example = th.from_numpy(policy.frozen().sample_observations(2))
    return cast(nn.Module, module.eval()), example.to(module.device)
