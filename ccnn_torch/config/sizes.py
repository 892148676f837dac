"""Sizes in a config: numbers in SI or texts such as `0.4 mm`, alone or by name, pattern or unit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.spelling import hint
from ccnn_torch.units import amount

ANGLE_ARM = 0.3
"""Distance of the points that determine orientation [m]: the noise of an angle is that of a length over this."""

Size = float | str
"""A number in SI, or a text of number and unit, such as `0.4 mm` or `0.03 deg`."""


def size(value: Size, unit: str | None, key: str) -> float:
    """A number in SI; unit None takes a text of any unit.

    Raises:
        InputError: a text that is no number with a unit, or a unit of another dimension; names the key.
    """
    return float(value) if isinstance(value, int | float) else amount(value, unit, key)


def sizes_by_name(
    given: Mapping[str, Size], coordinates: Sequence[Coordinate | Parameter], key: str, default: Sequence[float]
) -> Tensor:
    """One size for each coordinate or parameter, by name, pattern or unit, the last entry that fits; `len` [SI].

    Raises:
        InputError: an entry fits nothing (with the nearest name), or is no size.
    """
    values = torch.tensor([float(v) for v in default], dtype=torch.float64)
    names = [c.name for c in coordinates]
    for pattern, value in given.items():
        fits = [i for i, c in enumerate(coordinates) if c.unit == pattern or fnmatchcase(c.name, pattern)]
        if not fits:
            raise InputError(f"{key}.{pattern}: there is no such name; {hint(pattern, names)}")
        for i in fits:
            values[i] = size(value, coordinates[i].unit, f"{key}.{pattern}")
    return values


def sizes_of_pose(given: Size | Mapping[str, Size], coordinates: Sequence[Coordinate], key: str) -> Tensor:
    """Standard deviation of each pose coordinate: of a position, and of an angle over 0.3 m; or by name. `p` [SI].

    Where only angles are measured it is an angle.

    Raises:
        InputError: as `sizes_by_name`, or a coordinate has none.
    """
    if isinstance(given, Mapping):
        values = sizes_by_name(given, coordinates, key, [-1.0] * len(coordinates))
        missing = [c.name for c, v in zip(coordinates, values.tolist(), strict=True) if v < 0]
        if missing:
            raise InputError(f"{key}: gives no size of {', '.join(missing)}; add {missing[0]}, or write one number")
        return values
    angles = all(c.unit == "rad" for c in coordinates)
    base = size(given, "rad" if angles else "m", key)
    if base < 0:
        raise InputError(f"{key}: a standard deviation is not negative, got {given}")
    turned = base if angles else base / ANGLE_ARM
    return torch.tensor([turned if c.unit == "rad" else base for c in coordinates], dtype=torch.float64)


def sizes_of_joints(given: Size | Mapping[str, Size], coordinates: Sequence[Coordinate], key: str) -> Tensor:
    """Standard deviation of each joint, one for all or by name, pattern or unit; `n` [SI], 0 of what is not named.

    Raises:
        InputError: as `sizes_by_name`.
    """
    if isinstance(given, Mapping):
        return sizes_by_name(given, coordinates, key, [0.0] * len(coordinates))
    return torch.tensor([size(given, c.unit, key) for c in coordinates], dtype=torch.float64)


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


def prior_sizes(given: Mapping[str, Size], geometry: Sequence[Parameter], key: str) -> dict[str, float]:
    """Standard deviation of each prior [SI] by its name or pattern; a text has the unit of what it fits.

    Raises:
        InputError: a pattern that fits nothing, an entry that is no size, or a unit of another kind than that of a
            parameter that it fits.
    """
    # Imported here: other sizes need nothing of the identification.
    from ccnn_torch.identification.problems.parameters import match_parameters

    units = {p.name: p.unit for p in geometry}
    found = {}
    for pattern, value in given.items():
        fits = match_parameters(geometry, [pattern], key.partition(".")[2])
        kinds = list(dict.fromkeys(units[p.name] for p in geometry if p.name in fits))
        # Converted for every unit that the pattern matches, so that no mismatch is missed.
        found[pattern] = max(size(value, unit, f"{key}.{pattern}") for unit in kinds)
    return found
