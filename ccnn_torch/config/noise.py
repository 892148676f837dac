"""Noise of the pose as the user gives it: one size, or sizes by coordinate or unit, in SI or with a unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ccnn_torch.config.sizes import Size, size, sizes_by_name
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError

Noise = Size | dict[str, Size]


def read_noise(text: str) -> Noise:
    """Parse the argument of `--noise`: `1e-5`, `10um`, or `x=1e-5,y=20um` or `m=10um,rad=30urad`.

    Raises:
        InputError: it is none of these.
    """
    parts = [part.partition("=") for part in text.split(",") if part.strip()]
    given = {name.strip(): value.strip() for name, _, value in parts}
    alone = len(parts) == 1 and not parts[0][1]
    if not alone and not all(equals and name.strip() and value.strip() for name, equals, value in parts):
        given = {}
    if not given:
        raise InputError(
            f"--noise: '{text}' is neither a size nor NAME=SIZE,NAME=SIZE,… (standard deviation of the pose: 10um, or "
            "1e-5 in SI)"
        )
    sizes = [parts[0][0].strip()] if alone else [*given.values()]
    for value in sizes:
        size(value, None, f"--noise {text}")
    return sizes[0] if alone else {**given}


def noise_of_pose(given: Noise, coordinates: Sequence[Coordinate], key: str = "noise") -> dict[str, float]:
    """Standard deviation [SI] of the pose coordinates for which it is given.

    A number without a unit applies to lengths in metres and to angles in radians; names may be patterns, or a
    unit for all that have it.

    Raises:
        InputError: no such coordinate, a unit of another kind, a unit alone that does not suit all coordinates, or a
            value below 0.
    """
    if not isinstance(given, Mapping):
        units = {c.unit for c in coordinates}
        if isinstance(given, str) and len(units) > 1 and not _plain(given):
            raise InputError(
                f"{key}: '{given}' cannot be the noise of lengths and angles alike; write it of each, e.g. "
                f"m=10um,rad=30urad, or by name ({', '.join(c.name for c in coordinates)})"
            )
        given = dict.fromkeys((c.name for c in coordinates), given)
    values = sizes_by_name(given, coordinates, key, [math.nan] * len(coordinates)).tolist()
    found = {c.name: value for c, value in zip(coordinates, values, strict=True) if not math.isnan(value)}
    if any(isinstance(v, float | str) and math.isnan(size(v, None, key)) for v in given.values()):
        raise InputError(f"{key}: nan is no standard deviation; write a size from 0 up, e.g. 10um")
    low = next((name for name, value in found.items() if not 0 <= value < math.inf), None)
    if low is not None:
        raise InputError(f"{key}: a standard deviation is a number from 0 up, not {found[low]:g} for {low}")
    return found


def _plain(text: str) -> bool:
    """Whether it is a number without a unit."""
    try:
        float(text)
    except ValueError:
        return False
    return True
