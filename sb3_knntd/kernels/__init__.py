"""
The compiled CPU step. Everything here works on NumPy arrays and numbers alone, and knows nothing of the
rest of the package. Arrays that belong together travel as plain tuples, which numba takes in fastest;
each tuple is described where it is made.
"""

from __future__ import annotations
