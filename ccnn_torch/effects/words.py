"""Effects in the words of a technician: what each is called, what its numbers mean, and which part to look at."""

from __future__ import annotations

from typing import NamedTuple

from ccnn_torch.effects.parameter import PARAMETER
from ccnn_torch.effects.registry import OUTLIER

__all__ = ["Words", "words_of"]


class Words(NamedTuple):
    """What is said of an effect.

    Attributes:
        cause: in a sentence, as a cause of the gap.
        short: before the joints or legs that it is in, `harmonic error` of joint 2.
        meaning: what its numbers are, as a sentence; empty where they need none.
        look: the part to look at, as a sentence; `{where}` is replaced by joints, legs or links.
    """

    cause: str
    short: str
    meaning: str
    look: str


_WORDS = {
    "geometry": Words(
        "an error of the geometry",
        "geometry error",
        "The values were fitted together: enter all of diagnosis.json, not single ones.",
        "Mounting and lengths of {where}, where a value is off by more than its tolerance.",
    ),
    "joint_offset": Words(
        "an offset of the joints",
        "zero offset",
        "A positive offset: the joint goes this much further than commanded; subtract it from the command.",
        "Zero mark, reference switch or encoder offset of {where}: reference it again.",
    ),
    "joint_gain": Words(
        "a wrong gain of the joints",
        "wrong gear ratio or lead",
        "A positive gain: the joint moves this share too far.",
        "Gear ratio, screw lead or encoder scale of {where} in the controller.",
    ),
    "transmission": Words(
        "a periodic error of the transmission",
        "harmonic error",
        "The joint is off by sin · sin(n q) + cos · cos(n q): q is its command, n the times a turn (of a sliding joint "
        "2π over the length).",
        "Gear, belt, screw or encoder of {where}: eccentric, worn or badly mounted.",
    ),
    "backlash": Words(
        "backlash",
        "backlash",
        "The whole width of the play; half of it on either side.",
        "Gear, belt or screw of {where}: wear and preload.",
    ),
    "friction": Words(
        "friction in the joints",
        "friction",
        "Wind-up of the drive for each unit of load on it, against its last motion.",
        "Lubrication, seals and preload of the drive of {where}.",
    ),
    "compliance": Words(
        "joint compliance under load",
        "compliance",
        "How far the part gives for each unit of load on it.",
        "Bearings, gear and bolts of {where}: what gives under load.",
    ),
    "gravity": Words(
        "sag under the machine's own weight",
        "sag under the own weight",
        "Sag for each metre of lever of the weight on a turning joint, or along a sliding one.",
        "Counterbalance, brake and bearings of {where}, and the payload that the controller knows.",
    ),
    "thermal": Words(
        "growth with temperature",
        "thermal growth",
        "Growth of lengths for each kelvin.",
        "Warm-up before work, and heat near {where}: motors, sun, coolant.",
    ),
    "drift": Words(
        "drift over time",
        "drift",
        "",
        "Clamping of base, part and measuring device, and the warm-up of {where}.",
    ),
    "frame": Words(
        "a shifted or tilted base frame",
        "base frame off",
        "Where the measured machine stands, less where the frame says that it stands.",
        "The bolts of the base, and the base frame as taught or measured.",
    ),
    "tool": Words(
        "a shifted or tilted tool",
        "tool frame off",
        "Where the measured tool is, less where the tool frame says that it is.",
        "The tool frame (TCP), and the mount of the tool or the target.",
    ),
    "coupling": Words(
        "coupling between the joints",
        "coupling",
        "Motion of the first joint for each unit of motion of the second.",
        "Coupling factors in the controller, and gears or belts that run over {where}.",
    ),
    "latency": Words(
        "a delay between pose and command",
        "delay",
        "",
        "The time stamps: read pose and command at the same moment, or measure at rest.",
    ),
    "instrument": Words(
        "an error of the measuring device",
        "error of the measuring device",
        "",
        "Scale, set-up and calibration of the measuring device.",
    ),
    OUTLIER: Words("a few bad rows", "bad rows", "", "The rows set aside: measure them again."),
}


def words_of(name: str) -> Words:
    """The words of an effect by its name in verdicts; a user's own effect is called by its name."""
    if name.startswith(PARAMETER):
        own = name.removeprefix(PARAMETER)
        look = f"{own} in the simulator and as built."
        return Words(f"a wrong value of the parameter {own}", f"wrong value of {own}", "", look)
    whole = f"the effect {name}"
    return _WORDS.get(name, Words(whole, whole, "", f"What {name} describes, in {{where}}."))
