"""Families: which causes act, and on which machines."""

from __future__ import annotations

from collections.abc import Callable

from ccnn_validation.sources.multibody.arms import gantry, puma, seven, slim
from ccnn_validation.sources.multibody.delta import delta
from ccnn_validation.sources.multibody.five_bar import five_bar
from ccnn_validation.sources.multibody.machine import Machine
from ccnn_validation.sources.multibody.outsiders import OUTSIDERS
from ccnn_validation.sources.multibody.singles import SINGLES
from ccnn_validation.sources.multibody.stewart import stewart

__all__ = ["FAMILIES", "MACHINES", "machines_of", "parts_of"]

MACHINES: dict[str, Callable[[], Machine]] = {
    "five_bar": five_bar,
    "stewart": stewart,
    "delta": delta,
    "puma": puma,
    "slim": slim,
    "seven": seven,
    "gantry": gantry,
}

_ARMS = ("puma", "slim", "seven")
_PARALLEL = ("five_bar", "stewart", "delta")
# On three slides at right angles a wrong geometry is a wrong instrument, a tilted base couples the joints, and weight
# is a constant force: causes without an answer of their own.
_NOT_ON_A_GANTRY = (*_PARALLEL, *_ARMS)
_WHERE = {
    "geometry": _NOT_ON_A_GANTRY,
    "frame": _NOT_ON_A_GANTRY,
    "gravity": _NOT_ON_A_GANTRY,
    "payload": _NOT_ON_A_GANTRY,
    # Elsewhere the weight pushes one way all over the workspace: play is a constant offset.
    "backlash_weight": _ARMS,
    "tool": ("stewart", *_ARMS),
    "flex": _ARMS,
    "softening": _NOT_ON_A_GANTRY,
    # On a small workspace a cable's pull is nearly what other lengths of the legs make.
    "cable": _ARMS,
    "loose_bolt": _NOT_ON_A_GANTRY,
}

_PAIRS = (
    ("joint_offset", "thermal"),
    ("geometry", "thermal"),
    ("gravity", "thermal"),
    ("compliance", "thermal"),
    ("backlash", "thermal"),
    ("gravity", "joint_gain"),
    ("compliance", "joint_offset"),
    ("gravity", "frame"),
    ("friction", "latency"),
    ("friction", "joint_gain"),
    ("gravity", "compliance"),
)

FAMILIES: tuple[str, ...] = ("none", *SINGLES, *OUTSIDERS, *("+".join(pair) for pair in _PAIRS))


def parts_of(family: str) -> tuple[str, ...]:
    """Names of the causes that act together."""
    return () if family == "none" else tuple(family.split("+"))


def machines_of(family: str) -> tuple[str, ...]:
    """Machines on which all causes of a family make sense."""
    allowed = [set(_WHERE.get(part, MACHINES)) for part in parts_of(family)]
    return tuple(name for name in MACHINES if all(name in some for some in allowed))
