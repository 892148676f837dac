"""Machines of a workshop, their causes and plans, by somebody who had read the documentation of `ccnn diagnose` only.

He had seen no line of the package's code: machines, physics, random numbers and right answers are his own, in numpy and
scipy. The cases of seeds 1 to 3 have been looked at while the diagnosis was repaired: figures come from other seeds.
"""

from __future__ import annotations

from ccnn_torch.errors import InputError
from ccnn_validation.sources.case import SourceCase
from ccnn_validation.sources.shop.cases import built
from ccnn_validation.sources.shop.deal import FAMILIES, dealt

__all__ = ["FAMILIES", "make"]


def make(family: str, seed: int) -> SourceCase:
    """The case of a family and seed; the same for the same arguments.

    Raises:
        InputError: there is no such family.
    """
    if family not in FAMILIES:
        raise InputError(f"shop: family '{family}' is not there; known: {', '.join(FAMILIES)}")
    return built(dealt(seed)[family], seed)
