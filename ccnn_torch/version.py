"""The version of this package: in model files, checkpoints and results."""

__version__ = "0.1.0"
