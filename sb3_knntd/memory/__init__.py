"""What is it worth? The Q-table and its eligibility traces."""

from __future__ import annotations

from sb3_knntd.memory.live import LiveStore
from sb3_knntd.memory.table import DenseTable, HashedTable, QTable
from sb3_knntd.memory.traces import DenseTraces, OneStepTraces, Traces

__all__ = ["DenseTable", "DenseTraces", "HashedTable", "LiveStore", "OneStepTraces", "QTable", "Traces"]
