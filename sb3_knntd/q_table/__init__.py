"""The Q-table and its eligibility traces."""

from __future__ import annotations

from sb3_knntd.q_table.active_traces import ActiveTraces
from sb3_knntd.q_table.table import DenseTable, GrowingTable, HashedTable, QTable
from sb3_knntd.q_table.traces import DenseTraces, OneStepTraces, Traces

__all__ = [
    "ActiveTraces",
    "DenseTable",
    "DenseTraces",
    "GrowingTable",
    "HashedTable",
    "OneStepTraces",
    "QTable",
    "Traces",
]
