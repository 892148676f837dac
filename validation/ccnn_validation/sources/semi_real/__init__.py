"""Measured rows of real arms with one known cause added: the arm's own errors stay, unknown, in both sets of rows."""

from .build import FAMILIES, make

__all__ = ["FAMILIES", "make"]
