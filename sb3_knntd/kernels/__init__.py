"""
The compiled learning step for the CPU. Its modules use only NumPy arrays and numbers, and import no other part of the
package. Arrays that belong together are declared as named tuples beside the functions that take them.
"""

from __future__ import annotations
