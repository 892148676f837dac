"""Effects by the names that configs and verdicts use."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import cast

from ccnn_torch.effects._protocol import Effect, missing_verbs
from ccnn_torch.effects.backlash import Backlash
from ccnn_torch.effects.compliance import Compliance
from ccnn_torch.effects.coupling import Coupling
from ccnn_torch.effects.drift import Drift
from ccnn_torch.effects.frame import Frame
from ccnn_torch.effects.friction import Friction
from ccnn_torch.effects.geometry import Geometry
from ccnn_torch.effects.gravity import Gravity
from ccnn_torch.effects.instrument import Instrument
from ccnn_torch.effects.joint_gain import JointGain
from ccnn_torch.effects.joint_offset import JointOffset
from ccnn_torch.effects.latency import Latency
from ccnn_torch.effects.thermal import Thermal
from ccnn_torch.effects.tool import Tool
from ccnn_torch.effects.transmission import Transmission
from ccnn_torch.errors import InputError
from ccnn_torch.plugins import is_plugin, load_plugin

__all__ = ["EFFECTS", "OUTLIER", "make_effect"]

EFFECTS: dict[str, Callable[[], Effect]] = {
    "geometry": Geometry,
    "joint_offset": JointOffset,
    "joint_gain": JointGain,
    "transmission": Transmission,
    "backlash": Backlash,
    "friction": Friction,
    "compliance": Compliance,
    "gravity": Gravity,
    "thermal": Thermal,
    "drift": Drift,
    "frame": Frame,
    "tool": Tool,
    "coupling": Coupling,
    "latency": Latency,
    "instrument": Instrument,
}
"""Name -> maker. The order is that of listings."""

OUTLIER = "outlier"
"""What verdicts and simulations call bad rows. No effect: no other column foretells them."""


def make_effect(name: str) -> Effect:
    """An effect by name, or from a user's `path/to/file.py:Name` (a class that is called without arguments).

    Raises:
        InputError: no effect has this name, or what the file has is no effect.
    """
    if is_plugin(name):
        effect = load_plugin(name)()
        missing = missing_verbs(effect)
        if missing:
            raise InputError(
                f"effects: {name} is no effect, it lacks {', '.join(missing)} "
                "(ccnn_torch.testing.check_effect tells all that an effect needs)"
            )
        return cast(Effect, effect)
    if name not in EFFECTS:
        near = difflib.get_close_matches(name, EFFECTS, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(f"effects: {name!r} is no effect of this version, which has {', '.join(EFFECTS)}{hint}")
    return EFFECTS[name]()
