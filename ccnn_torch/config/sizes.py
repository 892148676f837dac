"""Sizes in a config: numbers in SI or texts such as `0.4 mm`, alone or by name, pattern or unit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.spelling import nearest
from ccnn_torch.units import to_si

ANGLE_ARM = 0.3
"""Distance of the points that determine orientation [m]: the noise of an angle is that of a length over this."""

Size = float | str
_WITH_UNIT = re.compile(r"(?P<number>[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?inf|nan)\s*(?P<unit>.*)", re.IGNORECASE)
_WRITTEN = {"m": "0.4 mm", "rad": "0.03 deg", "1": "0.002"}


def size(value: Size, unit: str | None, key: str) -> float:
    """A number in SI; unit None takes a text of any unit.

    Raises:
        InputError: a text that is no number with a unit, or a unit of another dimension; names the key.
    """
    if isinstance(value, int | float):
        return float(value)
    match = _WITH_UNIT.fullmatch(value.strip())
    if match is None:
        raise InputError(f"{key}: '{value}' is no number with a unit; write e.g. 0.4 mm, or a number in SI")
    amount = float(match["number"])
    if not match["unit"]:
        return amount
    hint = f"write e.g. {_WRITTEN.get(unit or '', 'a number')}, or a number in SI"
    return float(to_si(amount, match["unit"], unit, key, hint=hint))


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
            near = nearest(pattern, names)
            hint = f"did you mean '{near}'?" if near else f"there are {', '.join(names)}"
            raise InputError(f"{key}.{pattern}: there is no such name; {hint}")
        for i in fits:
            values[i] = size(value, coordinates[i].unit, f"{key}.{pattern}")
    return values


def sizes_of_pose(given: Size | Mapping[str, Size], coordinates: Sequence[Coordinate], key: str) -> Tensor:
    """Standard deviation of each pose coordinate: of a position, and of an angle over 0.3 m; or by name. `p` [SI].

    Raises:
        InputError: as `sizes_by_name`, or a coordinate has none.
    """
    if isinstance(given, Mapping):
        values = sizes_by_name(given, coordinates, key, [-1.0] * len(coordinates))
        missing = [c.name for c, v in zip(coordinates, values.tolist(), strict=True) if v < 0]
        if missing:
            raise InputError(f"{key}: gives no size of {', '.join(missing)}; add {missing[0]}, or write one number")
        return values
    base = size(given, "m", key)
    if base < 0:
        raise InputError(f"{key}: a standard deviation is not negative, got {given}")
    return torch.tensor([base / ANGLE_ARM if c.unit == "rad" else base for c in coordinates], dtype=torch.float64)


def sizes_of_joints(given: Size | Mapping[str, Size], coordinates: Sequence[Coordinate], key: str) -> Tensor:
    """Standard deviation of each joint, one for all or by name, pattern or unit; `n` [SI], 0 of what is not named.

    Raises:
        InputError: as `sizes_by_name`.
    """
    if isinstance(given, Mapping):
        return sizes_by_name(given, coordinates, key, [0.0] * len(coordinates))
    return torch.tensor([size(given, c.unit, key) for c in coordinates], dtype=torch.float64)
