"""What the project measures: `python -m benchmarks.speed`, `python -m benchmarks.learning`."""
