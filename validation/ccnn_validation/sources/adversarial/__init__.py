"""Cases made to break a diagnosis that assumes textbook forms, white noise and records without mistakes."""

from __future__ import annotations

import zlib

import numpy as np

from ccnn_validation.sources.adversarial.data_families import DATA_FAMILIES
from ccnn_validation.sources.adversarial.design_families import DESIGN_FAMILIES
from ccnn_validation.sources.adversarial.jump_families import JUMP_FAMILIES
from ccnn_validation.sources.adversarial.mixed_families import MIXED_FAMILIES
from ccnn_validation.sources.adversarial.noise_families import NOISE_FAMILIES
from ccnn_validation.sources.adversarial.odd_families import ODD_FAMILIES
from ccnn_validation.sources.case import SourceCase

__all__ = ["FAMILIES", "make"]

_BUILDERS = {
    **NOISE_FAMILIES,
    **DESIGN_FAMILIES,
    **MIXED_FAMILIES,
    **ODD_FAMILIES,
    **JUMP_FAMILIES,
    **DATA_FAMILIES,
}

FAMILIES: tuple[str, ...] = tuple(_BUILDERS)


def make(family: str, seed: int) -> SourceCase:
    """The case of a family and seed; the same for the same arguments.

    Raises:
        KeyError: there is no such family.
    """
    return _BUILDERS[family](family, np.random.default_rng([seed, zlib.crc32(family.encode())]))
