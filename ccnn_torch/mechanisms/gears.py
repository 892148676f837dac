"""What a file tells of the drives of a machine's joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError


def read_gears(
    told: Any, joints: Sequence[Coordinate], where: str, number: Callable[[Any, str], float]
) -> list[float | None]:
    """Of each joint turns of its motor for one of its own [1], or the lead of its screw [m], or None.

    Args:
        told: a list of them.
        joints: those of the machine.
        where: opens the sentence of an error.
        number: one that is told, and its unit, to SI.

    Raises:
        InputError: no list of as many, or one that is not above 0.
    """
    if not isinstance(told, list) or len(told) != len(joints):
        raise InputError(f"{where} must list {len(joints)} numbers, one for each joint, as [121, null, …]")
    found = [
        None if v is None else number(v, "1" if joint.unit == "rad" else joint.unit)
        for v, joint in zip(told, joints, strict=True)
    ]
    if any(v is not None and v <= 0 for v in found):
        raise InputError(f"{where} must be above 0, or null where nothing is known, not {told}")
    return found
