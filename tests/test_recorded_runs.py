"""Results do not change between versions: the tables of short runs, bit for bit if they are machine-independent."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_runs import (
    CONTINUED,
    FILTER,
    INEXACT,
    LENGTHS,
    RECORDED,
    RUNS,
    SAVED,
    continued,
    filtered,
    make_venv,
    table_of,
    tile_weights,
)

from sb3_knntd import VecDeltaFilter


@pytest.mark.parametrize("name", RUNS)
def test_table_is_as_recorded(name: str) -> None:
    with np.load(RECORDED) as recorded:
        expected = recorded[name]
    table = table_of(name)
    assert table.dtype == expected.dtype
    assert np.unique(expected).size > 20, "the run learned something"
    np.testing.assert_allclose(table, expected, rtol=1e-9 if name in INEXACT else 0.0)


def test_tile_coding_is_as_recorded() -> None:
    with np.load(RECORDED) as recorded:
        np.testing.assert_array_equal(tile_weights(), recorded["tile_sarsa"])


@pytest.mark.parametrize("name", SAVED)
def test_models_saved_by_the_first_version_continue_unchanged(name: str) -> None:
    with np.load(CONTINUED) as recorded:
        np.testing.assert_array_equal(continued(name), recorded[name])


def test_a_filter_saved_by_the_first_version_continues_unchanged() -> None:
    with np.load(CONTINUED) as recorded:
        np.testing.assert_array_equal(
            filtered(VecDeltaFilter.load(FILTER, make_venv(**LENGTHS), trusted=True)), recorded["filter"]
        )
