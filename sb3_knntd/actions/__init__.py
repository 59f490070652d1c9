"""From action values to an action."""

from __future__ import annotations
