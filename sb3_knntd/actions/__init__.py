"""Action selection and exploration."""

from __future__ import annotations
