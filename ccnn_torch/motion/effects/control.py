"""Effects of the control loop and of the drive: delay, gains, zero offset, limits, supply voltage."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add, scaled

# A smaller change of the recorded voltage shows nothing.
_LEAST_CHANGE = 0.03
# Share of the motor's limit from which a wrong nominal voltage shows.
_NEAR_LIMIT = 0.5
_PROPORTIONAL, _DERIVATIVE = "proportional gain", "derivative gain"
# Integral gains that are tried [1/s], and whether they are of a cascade.
_INTEGRALS = ((0.3, 0.0), (3.0, 0.0), (30.0, 1.0), (100.0, 1.0))
_SHARE, _VOLTAGE = "share of the voltage's change", "motor's strength"


def _gains(axis: Facts) -> tuple[Number, ...]:
    if not axis.driven:
        # The time by which the position lags, 1 over the velocity gain.
        return (Number("lag", "s", 0.03, (add("viscous"),)),)
    return (
        Number(_PROPORTIONAL, "1", 0.5, (scaled("gain"),), 0.0),
        # Of command less position, over the proportional gain; one of the position alone is viscous friction.
        Number(_DERIVATIVE, "s", 0.03, (add("derivative"),)),
    )


def _either_gain(axis: Facts) -> list[dict[str, float | None]]:
    if not axis.driven:
        return [{}]
    derivative = (0.01, -0.01) if axis.nominal.get("derivative") else (0.01,)
    either = [{_PROPORTIONAL: v, _DERIVATIVE: None} for v in (0.3, -0.3)]
    return [*either, *({_PROPORTIONAL: None, _DERIVATIVE: v} for v in derivative)]


def _usual(axis: Facts) -> float:
    """The largest acceleration of a sine with the span and the speed of the axis."""
    return 2 * axis.speed**2 / axis.span


def _recorded(axis: Facts) -> bool:
    return axis.supply >= _LEAST_CHANGE


def _limited(axis: Facts) -> bool:
    """Whether a wrong nominal voltage is more than a wrong gain: the motor comes near its limit."""
    return axis.driven and axis.nominal.get("weakness", 0.0) * axis.error >= _NEAR_LIMIT


def _unsupplied(axis: Facts) -> str:
    if _recorded(axis) or _limited(axis):
        return ""
    return (
        f"a column supply[V] that changes by {100 * _LEAST_CHANGE:.0f} %, or a motion near the limit that the motor has"
    )


def _strength(axis: Facts) -> tuple[Number, ...]:
    # Every axis has both; what it cannot show does nothing there.
    share, voltage = float(_recorded(axis)), float(_limited(axis))
    return (
        Number(_SHARE, "1", 1.0, (add("supply", share),), 0.5),
        # The gain and the limit that the model has hold at another voltage than the motor's.
        Number(_VOLTAGE, "1", 0.3, (scaled("gain", voltage), scaled("weakness", -voltage))),
    )


# Seconds: a bus of a few ms to a network of tens.
DELAY = MotionEffect("delay", lambda axis: (Number("delay", "s", 0.02, (add("delay"),)),))

# Of an axis of which nothing is known the proportional gain has nothing to work against; a finite gain is then a lag.
SERVO_GAIN = MotionEffect("servo_gain", _gains, _either_gain)


def _fed(axis: Facts) -> tuple[Number, ...]:
    lag = Number("lag", "s", 0.002, (add("forward_lag"),))
    if not axis.driven:
        # Of an axis of which nothing is known: time for which the command is sent ahead of itself.
        return Number("command's speed", "s", 0.03, (add("derivative"),)), lag
    return Number("share of the command's speed", "1", 0.05, (add("forward"),), 0.0), lag


# The drive feeds forward another share of the command's speed than was set, or later.
FEEDFORWARD = MotionEffect(
    "feedforward",
    _fed,
    missing=lambda axis: (
        "" if not axis.driven or axis.nominal.get("derivative") else "a derivative gain or a cascade in the model"
    ),
)

# Position and command differ by a constant.
OFFSET = MotionEffect("offset", lambda axis: (Number("offset", "joint", 0.02, (add("offset"),), 0.0),))

# The position is another share of the command: an electronic gear, counts per turn, or the range of a calibration.
JOINT_GAIN = MotionEffect("joint_gain", lambda axis: (Number("gain", "1", 0.01, (add("ratio"),), 0.0),))

# Within it the drive does nothing; without an inertia dry friction does the same.
DEAD_BAND = MotionEffect(
    "dead_band",
    lambda axis: (Number("dead band", "joint", 0.005, (add("dead_band"),), 1.0),),
    missing=lambda axis: "" if axis.nominal.get("inertia") else "an inertia of the axis in the model",
)

# A torque that grows as long as the position is not the commanded one; plausible is an integral time of a second.
INTEGRAL_ACTION = MotionEffect(
    "integral_action",
    lambda axis: (Number("integral gain", "1/s", 1.0, (add("integral"),)),),
    # Of the position alone, or of a cascade's error of speed.
    lambda axis: [{"integral gain": start, "cascade": kind} for start, kind in _INTEGRALS],
)

# A limit of the motor's torque, which falls with the speed as its voltage does not suffice for more.
SATURATION = MotionEffect(
    "saturation",
    lambda axis: (
        Number("torque", "torque", 2 / axis.error, (add("weakness"),), inverse=True),
        Number("speed without torque", "speed", 0.3 / axis.speed, (add("fading"),), 0.0, inverse=True),
    ),
    lambda axis: [{"torque": 1 / (share * axis.error)} for share in (0.1, 0.3, 0.9)],
)

# A limit of the speed: the drive follows a command no faster.
SPEED_LIMIT = MotionEffect(
    "speed_limit",
    lambda axis: (Number("speed", "speed", 2 / axis.speed, (add("slowness"),), inverse=True),),
    lambda axis: [{"speed": 1 / (share * axis.speed)} for share in (0.25, 0.5, 0.75, 0.9)],
)

# A limit of the acceleration of the set point (profile of a drive): as a sine that is nearly as fast as the motion.
ACCELERATION_LIMIT = MotionEffect(
    "acceleration_limit",
    lambda axis: (Number("acceleration", "acceleration", 1 / _usual(axis), (add("ramp"),), inverse=True),),
    lambda axis: [{"acceleration": 1 / (share * _usual(axis))} for share in (0.3, 1.0, 3.0, 10.0)],
)

# The motor's strength and its limit go with the voltage, damping and friction do not.
SUPPLY = MotionEffect(
    "supply",
    _strength,
    # One number or the other.
    lambda axis: [{_VOLTAGE: None}, *({_SHARE: None, _VOLTAGE: v} for v in (0.3, -0.3))],
    _unsupplied,
)
