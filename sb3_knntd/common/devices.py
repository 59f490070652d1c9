"""Validation of devices."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.utils import get_device

from sb3_knntd.common.checks import shown


def check_device(device: Any) -> th.device:
    """
    :param device: the given value
    :return: the device; as in SB3, the CPU if CUDA is not available
    :raises ValueError: if there is no such device, or it does not support float64
    """
    error: Exception | None = None
    if isinstance(device, (str, th.device)):
        try:
            found = get_device(device)
            # Some devices do not support float64, and some cannot store tensors at all.
            th.zeros(1, dtype=th.float64, device=found).item()
        except (AssertionError, RuntimeError, TypeError, ValueError) as raised:
            error = raised
        else:
            return found
    raise ValueError(f"device must be 'cpu', 'cuda', 'auto' or another of torch's; got {shown(device)}") from error
