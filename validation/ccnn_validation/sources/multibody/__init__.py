"""Rigid-body machines in MuJoCo, whose models are changed by a known cause."""

from __future__ import annotations

from ccnn_validation.sources.multibody.families import FAMILIES
from ccnn_validation.sources.multibody.records import make

__all__ = ["FAMILIES", "make"]
