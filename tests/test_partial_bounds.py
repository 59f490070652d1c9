"""Bounds of some dimensions, and ends that are left to be measured."""

from __future__ import annotations

import pathlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_knntd import KNNTD, VecDeltaFilter
from sb3_knntd.perception import make_bounds

SPACE = spaces.Box(np.float32([-1.0, -np.inf, 0.0, -np.inf]), np.float32([1.0, np.inf, np.inf, np.inf]))
SEEN = th.tensor([[0.0, -2.0, 1.0, 5.0], [0.5, 6.0, 3.0, 9.0]])


def measured(bounds: Any, seen: th.Tensor = SEEN) -> list[tuple[float, float]]:
    made = make_bounds(bounds, SPACE)
    made.measure(seen)
    return list(zip(made.low.tolist(), made.high.tolist(), strict=True))


def test_dimensions_that_are_not_named_are_as_without_bounds() -> None:
    without, partial = measured(None), measured({1: (-3, 3)})
    assert partial[1] == (-3.0, 3.0)
    assert [partial[dim] for dim in (0, 2, 3)] == [without[dim] for dim in (0, 2, 3)]
    # The one bound of the space in dimension 2 says little about its range.
    assert without == [(-1.0, 1.0), (-4.0, 8.0), (0.5, 3.5), (4.0, 10.0)]
    assert not make_bounds({1: (-3, 3), 2: (0, 5), 3: [4.0, 10.0]}, SPACE).is_open


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_an_end_that_is_nan_or_infinite_is_measured(unknown: float) -> None:
    low, high = np.array([-2.0, -unknown, 0.0, -unknown]), np.array([2.0, unknown, unknown, 7.0])
    assert measured((low, high)) == [(-2.0, 2.0), (-4.0, 8.0), (0.0, 3.5), (4.0, 7.0)]
    # All that was seen lies beyond the bound that is known: a range of one unit.
    assert measured({3: (20.0, unknown)})[3] == (20.0, 21.0)
    assert measured({3: (-unknown, 2.0)})[3] == (1.0, 2.0)


def test_a_model_measures_only_what_is_open(tmp_path: pathlib.Path) -> None:
    env = gym.make("CartPole-v1")
    whole = KNNTD(env, bounds={1: (-3, 3), 3: (-3, 3)}, points=4, seed=0).learn(30)
    # No random phase.
    assert whole.policy.table.n_visited > 0
    model = KNNTD(env, bounds={1: (-3, 3)}, points=4, seed=0).learn(1100)
    low = model.policy.perceiver.bounds.low
    assert float(low[1]) == -3.0
    assert float(low[3]) not in (-1.0, -3.0)
    model.save(tmp_path / "model")
    for trusted in (True, False):
        loaded = KNNTD.load(tmp_path / "model", env=env, trusted=trusted)
        assert th.equal(loaded.policy.perceiver.bounds.low, low)
        assert th.equal(loaded.policy.q_table, model.policy.q_table)
        loaded.learn(20, reset_num_timesteps=False)


def test_filters_take_them(tmp_path: pathlib.Path) -> None:
    venv = VecDeltaFilter(KNNTD("CartPole-v1").get_env(), bounds={1: (-3, 3), 3: (-3, 3)})
    venv.save(tmp_path / "filter")
    VecDeltaFilter.load(tmp_path / "filter", KNNTD("CartPole-v1").get_env())


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({4: (0, 1)}, "a dimension must be an integer from 0 to 3; got 4"),
        ({"x": (0, 1)}, "bounds must be None, 'adaptive', or a pair"),
        ({1: (3, -3)}, "low must be below high.* dimension 1"),
        ({1: 3}, "bounds must be"),
        ({1: (0, 1, 2)}, "bounds must be"),
        (([0, 0, 0, 0], [1e11, 1, 1, 1]), "at most 1e\\+10"),
        (([0, 0], [1, 1]), "shape"),
    ],
    ids=str,
)
def test_what_is_no_bound_is_named(bounds: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_bounds(bounds, SPACE)
