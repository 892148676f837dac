"""Truths of causes that the library has no name for."""

from __future__ import annotations

from collections.abc import Sequence

from ccnn_validation.sources.adversarial.effect import Effect, absorbed
from ccnn_validation.sources.adversarial.finish import NAMES_NOTHING
from ccnn_validation.sources.adversarial.rig import Rig
from ccnn_validation.sources.case import Truth

__all__ = ["SEEN", "load_names", "outside_smooth"]

# Names for the part of an error that is a smooth function of the place.
_SMOOTH = (
    frozenset({"joint_offset"}),
    frozenset({"joint_gain"}),
    frozenset({"joint_offset", "joint_gain"}),
    frozenset({"geometry"}),
    frozenset({"geometry", "joint_offset"}),
    frozenset({"geometry", "joint_gain"}),
)

SEEN = 2.0
"""In units of the noise: what the names of an answer must leave, so that it has to say outside."""

# A share of the error left above this: the smooth part is no finding of its own.
_HARDLY_SMOOTH = 0.9


def outside_smooth(rig: Rig, effect: Effect, strength: float, drivers: Sequence[str]) -> Truth:
    """An error that depends on the joints alone, without a name.

    Constants and gains of the joints and the geometry take up a part of such an error. Naming some of them for it is
    right where their part is large, and enough where they leave less than twice the noise.
    """
    left = {names: absorbed(rig, effect, names) for names in _SMOOTH}
    large = tuple(names for names in _SMOOTH if left[names] <= _HARDLY_SMOOTH)
    enough = tuple(names for names in large if left[names] * strength < SEEN)
    return Truth("outside", (effect.name,), (NAMES_NOTHING, *large), True, tuple(drivers), enough=enough)


def load_names(rig: Rig) -> tuple[str, ...]:
    """Names of the load columns."""
    return tuple(f"load_{n}" for n in rig.machine.pose_names)
