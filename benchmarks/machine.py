"""Description of the machine and software of a measurement."""

from __future__ import annotations

from sb3_knntd.experiments.compare.machine import machine, versions

PACKAGES = ("sb3-knntd", "stable-baselines3", "gymnasium", "torch", "numpy", "numba")


def describe() -> dict[str, str]:
    """
    :return: processor, cores, system and versions of the relevant packages
    """
    return machine() | versions(PACKAGES)
