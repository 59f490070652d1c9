"""Many runs at once, and environments on other machines."""

from __future__ import annotations
