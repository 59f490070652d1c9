"""Results stay what they were: the tables of short runs, to the bit where they do not depend on the machine."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_runs import INEXACT, RECORDED, RUNS, table_of


@pytest.mark.parametrize("name", RUNS)
def test_table_is_as_recorded(name: str) -> None:
    with np.load(RECORDED) as recorded:
        expected = recorded[name]
    table = table_of(name)
    assert table.dtype == expected.dtype
    assert np.unique(expected).size > 20, "the run learned something"
    np.testing.assert_allclose(table, expected, rtol=1e-9 if name in INEXACT else 0.0)
