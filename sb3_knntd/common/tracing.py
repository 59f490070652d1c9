"""Whether torch records what is done: for ``torch.jit.trace``, ``torch.export``, ``torch.compile`` or ONNX."""

from __future__ import annotations

import torch as th
from torch.jit import is_tracing  # type: ignore[attr-defined]


def is_traced() -> bool:
    """
    :return: whether torch is recording operations: only those on tensors are in what comes of it
    """
    return bool(is_tracing() or th.compiler.is_compiling())
