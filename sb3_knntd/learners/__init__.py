"""One step of learning: the torch reference, and the same compiled."""

from __future__ import annotations
