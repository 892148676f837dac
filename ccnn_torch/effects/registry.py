"""Effects by the names that configs and verdicts use."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pathlib import Path

from ccnn_torch.effects.backlash import Backlash, Friction
from ccnn_torch.effects.constant import Frame, Geometry, Instrument, Tool, parameter_causes
from ccnn_torch.effects.joints import Coupling, JointGain, JointOffset, Transmission
from ccnn_torch.effects.loads import Compliance, Gravity
from ccnn_torch.effects.protocol import Effect
from ccnn_torch.effects.time import Drift, Latency, Thermal
from ccnn_torch.effects.user_effect import owned
from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.plugins import class_hint, failure, is_plugin, load_plugin

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

EXACT = frozenset({"geometry", "joint_offset", "joint_gain", "frame", "tool", "instrument"})
"""Effects whose form is kinematics: what they leave is something else, where friction, growth or a belt that couples
two joints may just be of another form than the textbook's."""

OUTLIER = "outlier"
"""What verdicts and simulations call bad rows. No effect: no other column foretells them."""


def make_effect(name: str, mechanism: Mechanism | None = None) -> Effect:
    """An effect by name, or from a user's `path/to/file.py:Name` (a class that is called without arguments).

    Args:
        name: of the library, of a file, or `parameter NAME` for a cause that the mechanism's parameters name.
        mechanism: the one that the effect is for.

    Raises:
        InputError: no effect has this name, or what the file has is no effect. What a user's own effect gives later is
            checked whenever it is asked (`OwnEffect`).
    """
    if is_plugin(name):
        make = load_plugin(name)
        try:
            effect = make()
        except CcnnError:
            raise
        except (Exception, SystemExit) as error:  # a user's code may raise anything
            raise InputError(f"{name}: making it without arguments {failure(error, name)}") from error
        return owned(effect, name)
    if Path(name).suffix == ".py":
        raise InputError(f"effects: {class_hint(name)}")
    if name not in EFFECTS:
        own = {} if mechanism is None else {e.name: e for e in parameter_causes(mechanism)}
        plain = {_plain(n): e for n, e in own.items()}
        if _plain(name) in plain:
            return plain[_plain(name)]
        near = difflib.get_close_matches(name, [*EFFECTS, *own], 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        known = ", ".join([*EFFECTS, *own])
        raise InputError(f"effects: {name!r} is no effect of this version, which has {known}{hint}")
    return EFFECTS[name]()


def effect_names(mechanism: Mechanism) -> list[str]:
    """Of the library's effects, and of the causes that the mechanism's own parameters name."""
    return [*EFFECTS, *(e.name for e in parameter_causes(mechanism))]


def _plain(name: str) -> str:
    return "_".join(name.lower().split())
