"""RL Zoo's commands with ``knntd`` and ``exa`` added to its algorithms (extra ``[zoo]``)."""

from __future__ import annotations

from sb3_knntd.zoo.scripts import SCRIPTS, register, run

__all__ = ["SCRIPTS", "register", "run"]
