"""What a model has learned and why it acts as it does: explanations, diagnoses, and a page for the browser."""

from __future__ import annotations

from sb3_knntd.insight.diagnosis import Diagnosis, Finding, diagnose
from sb3_knntd.insight.explanation import Explanation, explain
from sb3_knntd.insight.inspectable import Inspectable
from sb3_knntd.insight.neighbor import Neighbor
from sb3_knntd.insight.page import Episodes, read_monitor, write_page

__all__ = [
    "Diagnosis",
    "Episodes",
    "Explanation",
    "Finding",
    "Inspectable",
    "Neighbor",
    "diagnose",
    "explain",
    "read_monitor",
    "write_page",
]
