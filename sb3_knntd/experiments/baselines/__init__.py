"""Baseline algorithms for comparisons."""

from __future__ import annotations
