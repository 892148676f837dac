"""Effects in the words of a technician: what each is called, what its numbers mean, and which part to look at."""

from __future__ import annotations

from typing import NamedTuple

from ccnn_torch.effects.apply import BY
from ccnn_torch.effects.constant import PARAMETER
from ccnn_torch.effects.registry import OUTLIER


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
        "The values were fitted together, and single ones do not correct the machine: all are in corrected.yaml, or "
        "else in diagnosis.json.",
        "Mounting and lengths of {where}, of sliding axes their squareness, where a value is off by more than its "
        "tolerance.",
    ),
    "error_motion": Words(
        "guides or bearings that do not run true",
        "error motion of the axis",
        "Shift along x, y, z and turn about x, y, z of what the joint carries: of a sliding joint by Legendre's "
        "polynomial of that degree less the one two degrees lower, from one end of its travel (-1) to the other (1), "
        "of a turning one by the sine or cosine of its angle, or of twice that. Of a motion how much further the joint "
        "goes, times the square and the third power of its position.",
        "Guides and bearings of {where}: their alignment, their bed, and the load on them.",
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
        "A positive gain: the joint moves this share too far, counted from the command beside it; zero: how far it "
        "stands off there.",
        "Gear ratio, screw lead or encoder scale of {where} in the controller.",
    ),
    "transmission": Words(
        "a periodic error of the transmission",
        "harmonic error",
        "The joint is off by sin · sin(n q) + cos · cos(n q): q is its command, n the times a turn (of a sliding joint "
        "2π over the length; of a motion it is lead_order).",
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
    "thermal_compliance": Words(
        "a stiffness that changes with the temperature",
        "thermal change of stiffness",
        "Change for each kelvin above 20 °C of how far the joint gives: for each unit of load, or under the machine's "
        "own weight.",
        "Belts, plastics, bearings and grease of {where}: what softens with warmth.",
    ),
    "sag": Words(
        "joint compliance under the torque of the drives",
        "compliance",
        "How far the joint gives for each unit of its torque; negative where that is what the drive holds with.",
        "Gear, belt or screw of {where}: its stiffness, and whether the controller compensates it.",
    ),
    "gravity": Words(
        "sag under the machine's own weight",
        "sag under the own weight",
        "Sag for each metre of lever of the weight on a turning joint, or along a sliding one. Of a motion the torque "
        "of the weight beyond the model's, or where the gain is not given the angle by which the command must lead.",
        "Counterbalance, brake and bearings of {where}, and the payload that the controller knows.",
    ),
    "bending": Words(
        "links that bend or a base that tilts",
        "bending",
        "1 / (E I) of a link as a beam, or the tilt of the base a N·m about its axes, for each unit of load; of weight "
        "and tool that times the weight.",
        "{where}: what the tube, casting or extension is made of, and its bolts; and what the base stands on.",
    ),
    "thermal": Words(
        "growth with temperature",
        "thermal growth",
        "Growth of lengths for each kelvin; reference: all lengths at 20 °C against the model's, which a geometry may "
        "stand for as well.",
        "Warm-up before work, and heat near {where}: motors, sun, coolant.",
    ),
    "drift": Words(
        "drift over time",
        "drift",
        "",
        "Clamping of base, part and measuring device, and the warm-up of {where}.",
    ),
    "homing": Words(
        "a new zero of the joints after a pause, or from a row on",
        "new zero by session",
        "The zero of each session between two pauses, or before and after the time of begin.",
        "Homing of {where}: reference switch, index pulse or battery of the encoder. Home again, or measure the zero "
        "at each start: the next one has another, and commands are not corrected for it.",
    ),
    "frame_drift": Words(
        "a measuring frame that moves in time",
        "drift of the measuring frame",
        "How far the frame is gone at the last row, about the middle of the workspace.",
        "The stand of the measuring device and the clamping of the base: what creeps, warms up or was touched. It is "
        "none of the machine, and commands are not corrected for it.",
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
        "Motion of the first joint for each unit of motion of the second, counted from the command beside it; zero: "
        "how far the first stands off there.",
        "Coupling factors in the controller, and gears or belts that run over {where}.",
    ),
    "latency": Words(
        "a delay between pose and command",
        "delay",
        "",
        "The time stamps: read pose and command at the same moment, or measure at rest.",
    ),
    "flexure": Words(
        "flexure of the tube or refraction",
        "flexure of the tube or refraction",
        "Towards the zenith: TF times the sine of the zenith distance and TX times its tangent.",
        "The mirror and its cell, the truss of the tube; of TX also the correction for refraction (pressure, "
        "temperature, humidity, colour).",
    ),
    "instrument": Words(
        "an error of the measuring device",
        "error of the measuring device",
        "",
        "Scale, set-up and calibration of the measuring device.",
    ),
    "delay": Words(
        "a delay between command and motion",
        "delay",
        "",
        "Bus, controller cycle and time stamps of {where}.",
    ),
    "servo_gain": Words(
        "wrong gains of the position control",
        "wrong servo gain",
        "How much higher the proportional gain is than in the model. A lag: 1 over the velocity gain.",
        "Proportional and velocity gain of {where} in the drive and in the model.",
    ),
    "feedforward": Words(
        "another feedforward of speed than is set",
        "wrong feedforward",
        "How much larger the share of the command's speed is than in the model, and how much later it comes.",
        "Feedforward of speed of {where} in the drive and in the model, and whether the drive filters it.",
    ),
    "integral_action": Words(
        "integral action of the position control",
        "integral action",
        "The integral gain over the proportional one, beyond that of the model: 1 over the integral time.",
        "Integral gain of {where} in the drive and in the model.",
    ),
    "offset": Words(
        "a constant offset between command and position",
        "offset",
        "A positive offset: the joint stands this much further than commanded.",
        "Zero mark or encoder offset of {where}.",
    ),
    "payload": Words(
        "a wrong load at the end of the axis",
        "wrong load",
        "The mass beyond that of the model.",
        "Tool and load of {where}: their mass and lever in the model.",
    ),
    "inertia": Words(
        "an inertia that the model lacks",
        "inertia",
        "Beyond that of the model; in s², over the proportional gain, where the gain is not given.",
        "Armature, gear and load of {where} in the model.",
    ),
    "viscous": Words(
        "viscous friction",
        "viscous friction",
        "Beyond that of the model; in s, over the proportional gain, where the gain is not given.",
        "Lubrication, seals and the motor's damping (back-EMF) of {where}.",
    ),
    "coulomb": Words(
        "dry friction",
        "dry friction",
        "As a torque, or where the gain is not given as the angle by which the command must lead; and a share of the "
        "torques of motor and load together, at rest twice the load.",
        "Seals, bearings and gear of {where}.",
    ),
    "stribeck": Words(
        "dry friction that falls with the speed",
        "Stribeck friction",
        "Dry friction at rest beyond that in motion.",
        "Lubrication of {where}, and slow motions.",
    ),
    "flexible_joint": Words(
        "a flexible joint",
        "flexible joint",
        "Inertia of the driven side over the stiffness: it swings with 1 / (2π √number) Hz.",
        "Gear, belt, coupling and link of {where}: what bends under acceleration.",
    ),
    "speed_limit": Words(
        "a limit of the speed",
        "speed limit",
        "",
        "Speed limit and trajectory settings of {where}, and the supply voltage.",
    ),
    "acceleration_limit": Words(
        "a limit of the set point's acceleration",
        "acceleration limit",
        "The largest acceleration of the set point that the drive makes of the commands.",
        "Profile acceleration, ramp or trajectory settings of {where}.",
    ),
    "dead_band": Words(
        "a dead band of the position control",
        "dead band",
        "The largest error that the drive does nothing about.",
        "Dead band, deadzone or in-position window of the drive of {where}.",
    ),
    "saturation": Words(
        "a limit of the motor's torque",
        "torque limit",
        "As a torque, or where the gain is not given as the error at which the motor gives its most.",
        "Current or PWM limit of {where}.",
    ),
    "supply": Words(
        "the supply voltage",
        "wrong supply voltage",
        "How much stronger the motor is than in the model; 100 % of the voltage's change: its strength goes with the "
        "recorded voltage.",
        "Supply voltage of {where}, under load.",
    ),
    "cogging": Words(
        "a torque that repeats with the angle",
        "cogging",
        "Torque sin · sin(n q) + cos · cos(n q), n the times a turn (of a sliding joint 2π over the length).",
        "Motor poles, gear teeth and eccentric wheels of {where}.",
    ),
    "thermal_friction": Words(
        "friction that changes with the temperature",
        "thermal change of friction",
        "Change of the dry friction for each kelvin above the coldest sample, as a share of it.",
        "Grease and warm-up of {where}.",
    ),
    OUTLIER: Words("a few bad rows", "bad rows", "", "The rows set aside: measure them again."),
}


def words_of(name: str) -> Words:
    """The words of an effect by its name in verdicts; a user's own effect is called by its name."""
    if name.startswith(PARAMETER) and name not in _WORDS:
        own = name.removeprefix(PARAMETER)
        look = f"{own} in the simulator and as built."
        return Words(f"a wrong value of the parameter {own}", f"wrong value of {own}", "", look)
    if BY in name:
        own, _, group = name.partition(BY)
        words, each = words_of(own), f", another one in each {group}"
        return words._replace(cause=words.cause + each, short=words.short + each)
    whole = f"the effect {name}"
    return _WORDS.get(name, Words(whole, whole, "", f"What {name} describes, in {{where}}."))
