"""What a run was computed on."""

from __future__ import annotations

import os
import platform
import resource
import sys
from collections.abc import Sequence
from importlib.metadata import version

#: Those that decide what a run computes.
PACKAGES = (
    "sb3-knntd",
    "stable-baselines3",
    "sb3-contrib",
    "rl-zoo3",
    "gymnasium",
    "torch",
    "numpy",
    "numba",
    "scipy",
)


def versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """
    :param packages: names of installed distributions
    :return: Python's version and theirs
    """
    return {"python": platform.python_version(), **{package: version(package) for package in packages}}


def machine() -> dict[str, str]:
    """
    :return: processor, number of cores and system
    """
    processor = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            processor = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {"processor": processor, "cores": str(os.cpu_count()), "system": f"{platform.system()} {platform.machine()}"}


def peak_memory() -> int:
    """
    :return: the most memory that this process has had at once, bytes
    """
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
