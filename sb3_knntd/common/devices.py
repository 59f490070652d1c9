"""Where tensors are."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.utils import get_device

from sb3_knntd.common.checks import shown


def check_device(device: Any) -> th.device:
    """
    :param device: what was given
    :return: the device it means; the CPU for CUDA where there is none, as in SB3
    :raises ValueError: if there is no such device, or it cannot hold a table
    """
    error: Exception | None = None
    if isinstance(device, (str, th.device)):
        try:
            found = get_device(device)
            # Some devices hold no float64, and some nothing at all.
            th.zeros(1, dtype=th.float64, device=found).item()
        except (AssertionError, RuntimeError, TypeError, ValueError) as raised:
            error = raised
        else:
            return found
    raise ValueError(f"device must be 'cpu', 'cuda', 'auto' or another of torch's; got {shown(device)}") from error
