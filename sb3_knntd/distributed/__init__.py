"""Run jobs in parallel, and environments on other machines."""

from __future__ import annotations
