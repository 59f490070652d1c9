"""What a figure was measured on."""

from __future__ import annotations

import os
import platform

import gymnasium
import numba
import numpy
import stable_baselines3
import torch

import sb3_knntd


def describe() -> dict[str, str]:
    """
    :return: processor, cores, system and the versions that matter
    """
    processor = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            processor = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "processor": processor,
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "sb3_knntd": sb3_knntd.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "gymnasium": gymnasium.__version__,
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "numba": numba.__version__,
    }
