"""Detect tracing by ``torch.jit.trace``, ``torch.export``, ``torch.compile`` or ONNX export."""

from __future__ import annotations

import torch as th
from torch.jit import is_tracing  # type: ignore[attr-defined]


def is_traced() -> bool:
    """
    :return: whether torch is tracing. A trace contains only operations on tensors
    """
    return bool(is_tracing() or th.compiler.is_compiling())
