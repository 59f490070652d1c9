"""Benchmarks: `python -m benchmarks.speed`, `python -m benchmarks.learning` and others."""
