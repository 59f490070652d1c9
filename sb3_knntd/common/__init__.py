"""What every part uses: checks, files, schedules, random numbers."""

from __future__ import annotations
