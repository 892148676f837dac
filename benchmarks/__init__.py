"""Measured times of this package beside named peers: `python -m benchmarks`."""
