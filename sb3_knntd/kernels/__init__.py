"""
The compiled CPU step. Its modules use NumPy arrays and numbers only, and import nothing else of the package. Arrays
that belong together are declared as named tuples beside the functions that take them.
"""

from __future__ import annotations
