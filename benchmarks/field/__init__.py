"""A benchmark of calibration on measured robots, for any method: python -m benchmarks.field --data FOLDER."""
