"""Comparisons, the paper's figures, the demonstration."""

from __future__ import annotations
