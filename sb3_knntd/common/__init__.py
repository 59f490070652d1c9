"""Used by all other packages: checks, files, schedules, random numbers."""

from __future__ import annotations
