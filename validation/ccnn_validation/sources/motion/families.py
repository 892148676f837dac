"""The families of cases: each cause alone, pairs, none, outside the library; and an arm of six axes."""

from __future__ import annotations

from ccnn_validation.sources.case import Truth

__all__ = ["CAUSES", "FAMILIES", "OUTSIDE", "PAIRS", "SIX", "truth_of"]

CAUSES = (
    *("delay", "servo_gain", "offset", "gravity", "payload", "inertia", "viscous", "coulomb", "stribeck", "backlash"),
    *("flexible_joint", "speed_limit", "saturation", "supply", "cogging", "integral_action"),
    "derivative_gain",
)
PAIRS = (
    ("delay", "coulomb"),
    ("payload", "backlash"),
    ("servo_gain", "offset"),
    ("viscous", "coulomb"),
    ("delay", "saturation"),
    ("inertia", "coulomb"),
)
# A stop of rubber near one end of the motion; an encoder that drifts; a brake that drags for part of the time.
OUTSIDE = {"rubber_stop": ("position",), "drifting_encoder": ("time",), "dragging_brake": ("time",)}
SIX = ("delay", "coulomb", "backlash", "offset", "speed_limit")
FAMILIES = (
    "none",
    *CAUSES,
    *("+".join(pair) for pair in PAIRS),
    *OUTSIDE,
    "six_none",
    *(f"six_{cause}" for cause in SIX),
)

# What may be said instead: the same change of the machine in other words.
_ALSO = {
    # The mass adds weight and inertia; which of both shows depends on the motion.
    "payload": ({"gravity", "inertia"}, {"gravity"}),
    # The mean of the voltage is a lower gain; the columns tell no nominal voltage.
    "supply": ({"supply", "servo_gain"},),
    # The friction at rest and the rest of it are one thing to a slow motion.
    "stribeck": ({"coulomb", "stribeck"},),
}


def truth_of(family: str) -> Truth:
    """What a right answer says."""
    name = family.removeprefix("six_")
    if name == "none":
        return Truth("none", (), (frozenset(),))
    if name in OUTSIDE:
        return Truth("outside", (name,), (frozenset(),), True, OUTSIDE[name])
    causes = tuple("servo_gain" if cause == "derivative_gain" else cause for cause in name.split("+"))
    accepted = [frozenset(causes)]
    for cause in causes:
        for other in _ALSO.get(cause, ()):
            accepted.append(frozenset(other) | (frozenset(causes) - {cause}))
    return Truth("pair" if len(causes) > 1 else "single", causes, tuple(accepted))
