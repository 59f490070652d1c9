"""Settings that need too much memory are refused before allocation, with the required size."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_knntd import KNNTD, ExA
from sb3_knntd.common.checks import check_size, in_bytes
from sb3_knntd.filters import DeltaFilter


class Still(gym.Env[Any, Any]):
    """An environment with given spaces that is never stepped."""

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def box(n: int) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (n,), np.float32)


PLANE, TWO = box(2), spaces.Discrete(2)


@pytest.mark.parametrize(
    ("make", "named", "size"),
    [
        (lambda: KNNTD(Still(PLANE, TWO), points=[10**9, 10**9]), "points", "29.8 GiB"),
        (lambda: KNNTD(Still(PLANE, TWO), points=10**9), "points", "29.8 GiB"),
        (lambda: KNNTD(Still(spaces.Discrete(10**9), TWO)), "points", "14.9 GiB"),
        (lambda: KNNTD(Still(spaces.MultiDiscrete([10**9, 3]), TWO)), "points", "14.9 GiB"),
        (lambda: KNNTD(Still(PLANE, spaces.Discrete(10**7))), "action space", "76.29 GiB"),
        (lambda: KNNTD(Still(PLANE, spaces.Discrete(10**9))), "action space", "7.451 TiB"),
        (lambda: KNNTD(Still(PLANE, TWO), points=10**5, policy_kwargs={"table": "dense"}), "points", "149 GiB"),
        (lambda: KNNTD(Still(box(12), TWO), points=10, search="brute"), "search", "261.9 TiB"),
        (lambda: KNNTD(Still(box(12), TWO), points=10, search="kd_tree"), "search", "261.9 TiB"),
        (lambda: KNNTD(Still(box(12), TWO), points=10, n_neighbors=10**11), "n_neighbors", "1.455 TiB"),
        (lambda: ExA(Still(PLANE, box(1)), action_points=10**18), "action_points", "20.82 EiB"),
        (lambda: ExA(Still(PLANE, box(3)), action_points=[3, 10**12, 3]), "action_points of dimension 1", "21.83 TiB"),
        (lambda: ExA(Still(PLANE, box(1)), action_points=10**7), "action_points", "76.29 GiB"),
        (lambda: DeltaFilter(Still(PLANE, TWO), points=[10**9, 10**9]), "points", "29.8 GiB"),
        (lambda: DeltaFilter(Still(PLANE, spaces.Discrete(10**7))), "points", "89.41 GiB"),
        (lambda: DeltaFilter(Still(PLANE, box(1)), action_points=10**18), "action_points", "20.82 EiB"),
    ],
)
def test_too_large_settings_are_refused(make: Callable[[], Any], named: str, size: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="more than 4 GiB") as error:
            make()
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert named in str(error.value)
    assert size in str(error.value)
    assert taken < 2**28


@pytest.mark.parametrize(
    ("env", "arguments"),
    [
        (Still(box(12), TWO), {"points": 10}),
        (Still(spaces.MultiDiscrete([10**4] * 4), TWO), {}),
        (Still(spaces.Discrete(10**6), TWO), {}),
        (Still(PLANE, spaces.Discrete(1000)), {}),
    ],
    ids=["10^12 points", "10^16 states", "10^6 states", "1000 actions"],
)
def test_large_lattices_with_hashed_tables_are_accepted(env: gym.Env[Any, Any], arguments: dict[str, Any]) -> None:
    model = KNNTD(env, seed=0, **arguments).learn(10)
    assert model.policy.table.n_visited >= 1


def test_sizes_are_printed_in_readable_units() -> None:
    assert [in_bytes(n) for n in (0, 1000, 2**10, 3 * 2**29, 10**20, 10**400)] == [
        "0 bytes", "1,000 bytes", "1 KiB", "1.5 GiB", "86.74 EiB", "1.00e+400 bytes",
    ]  # fmt: skip
    check_size("as much as is taken", 2**32, "nothing")
