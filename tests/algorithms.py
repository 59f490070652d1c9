"""The algorithms that tests of what is promised for all run with."""

from __future__ import annotations

from typing import Any

import pytest

from sb3_knntd import KNNTD, ExA, KNNDyna


class BoxDyna(KNNDyna):
    """KNNDyna where the environments of the tests have Box actions."""


#: all of them, and those with Box actions
ALGORITHMS = [KNNTD, ExA, KNNDyna, BoxDyna]
ON_BOX = (ExA, BoxDyna)
#: For what concerns traces, exploration, or points that are laid out in advance.
TD_ONLY = pytest.mark.parametrize("algorithm", [KNNTD, ExA])
#: Arguments that KNNDyna does not have.
TD_ARGUMENTS = {
    "exploration_final_eps",
    "exploration_fraction",
    "exploration_hold",
    "exploration_initial_eps",
    "initial_value",
    "n_neighbors",
    "points",
    "tie_break",
}


def fitting(algorithm: type[Any], arguments: dict[str, Any]) -> dict[str, Any]:
    """The arguments without those that the algorithm does not have."""
    if not issubclass(algorithm, KNNDyna):
        return arguments
    return {name: value for name, value in arguments.items() if name not in TD_ARGUMENTS}
