"""What is wrong with a machine, as numbers of its MuJoCo model, and the pieces of MJCF that all machines share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.multibody.arrays import Array

__all__ = ["RIGID", "Build", "document", "drive_joints", "inertia", "numbers", "placed", "platform_joints"]

RIGID = 1e9
"""Stiffness of a servo that does not give [N*m/rad, N/m]."""


@dataclass(frozen=True)
class Build:
    """A machine as built; the defaults are the nominal machine.

    Attributes:
        lengths: parameters of the geometry that differ from the drawing, name -> value [SI].
        zero: error of each drive's zero, `n` [rad, m]; None = none.
        gain: share by which each drive goes too far, `n` [1]; None = none.
        servo: stiffness of each position servo, `n` [N*m/rad, N/m]; None = rigid.
        gravity: the world has gravity.
        carried: share of the own weight that the servos feed forward (MuJoCo's gravcomp), 0 or 1.
        payload: mass at the tool [kg].
        friction: dry friction of each drive, `n` [N*m, N]; None = none.
        damping: viscous damping of each drive, `n` [N*m*s/rad, N*s/m]; None = none.
        play: width of the play between motor and link, `n` [rad, m]; None = none.
        flex: stiffness of springs across each drive's axis in its link, `n` [N*m/rad]; inf = rigid; None = all rigid.
        base: place of the whole machine in the world: shift [m] and rotation vector [rad].
        tool: the same of the measured point against the tool flange.
        stop: joint (from 0), where a soft stop begins, its side (+1: beyond, -1: below), its stiffness; None = none.
        cable: a point of the world [m], stiffness [N/m] and slack length [m] of a cable to the tool; None = none.
    """

    lengths: dict[str, float] = field(default_factory=dict)
    zero: Array | None = None
    gain: Array | None = None
    servo: Array | None = None
    gravity: bool = False
    carried: float = 0.0
    payload: float = 0.0
    friction: Array | None = None
    damping: Array | None = None
    play: Array | None = None
    flex: Array | None = None
    base: tuple[float, ...] = (0.0,) * 6
    tool: tuple[float, ...] = (0.0,) * 6
    stop: tuple[int, float, float, float] | None = None
    cable: tuple[tuple[float, float, float], float, float] | None = None


def numbers(values: Sequence[float] | Array) -> str:
    """Numbers as MJCF has them, to the last digit."""
    return " ".join(repr(float(v)) for v in values)


def placed(position: Sequence[float] | Array, rotation: Rotation | None = None) -> str:
    """Attributes `pos` and `quat` of a body or site."""
    quaternion = (Rotation.identity() if rotation is None else rotation).as_quat()
    return f'pos="{numbers(position)}" quat="{numbers(quaternion[[3, 0, 1, 2]])}"'


def inertia(mass: float, centre: Sequence[float] | Array, build: Build) -> tuple[str, str]:
    """The attribute `gravcomp` of a body and its element `inertial`; only the mass matters at rest."""
    element = f'<inertial mass="{mass!r}" pos="{numbers(centre)}" diaginertia="{numbers([0.01 * mass] * 3)}"/>'
    return f'gravcomp="{build.carried!r}"', element


def drive_joints(drive: int, axis: Sequence[float], build: Build, sliding: bool = False) -> str:
    """Joints of a driven link: the motor's, behind it the play, behind that springs across the drive's axis."""
    kind = "slide" if sliding else "hinge"
    friction = 0.0 if build.friction is None else float(build.friction[drive])
    damping = 0.0 if build.damping is None else float(build.damping[drive])
    along = f'type="{kind}" axis="{numbers(axis)}"'
    # A link at the joint value `ref` stands as at 0: a drive whose zero is off.
    zero = 0.0 if build.zero is None else -float(build.zero[drive])
    lossy = f'frictionloss="{friction!r}" damping="{damping!r}" armature="0.01"'
    text = f'<joint name="q{drive + 1}" {along} ref="{zero!r}" {lossy}/>'
    if build.play is not None and build.play[drive] > 0:
        half = float(build.play[drive]) / 2
        text += f'<joint name="play{drive + 1}" {along} limited="true" range="{-half!r} {half!r}" armature="0.01"/>'
    if build.flex is not None and np.isfinite(build.flex[drive]):
        for number, across in enumerate(np.eye(3)[np.abs(axis) < 0.5]):
            text += f'<joint name="flex{drive + 1}_{number}" type="hinge" axis="{numbers(across)}" '
            text += f'stiffness="{float(build.flex[drive])!r}" armature="0.01"/>'
    return text


def platform_joints() -> str:
    """Six joints of a free platform: three slides, three hinges; its turns are too small for a gimbal lock."""
    axes = list(zip("xyz", np.eye(3), strict=True))
    slides = "".join(f'<joint name="p{c}" type="slide" axis="{numbers(a)}"/>' for c, a in axes)
    return slides + "".join(f'<joint name="r{c}" type="hinge" axis="{numbers(a)}"/>' for c, a in axes)


def document(bodies: str, loops: Sequence[tuple[str, str]], drives: int, build: Build, down: Sequence[float]) -> str:
    """A whole MJCF model.

    Args:
        bodies: of the machine, in its base frame; with a site `tool`.
        loops: pairs of sites that are one point.
        drives: number of joints q1, q2, …
        build: what is wrong.
        down: direction of gravity.
    """
    servo = np.full(drives, RIGID) if build.servo is None else build.servo
    weight = 9.81 * np.asarray(down) if build.gravity else np.zeros(3)
    closed = "".join(f'<connect site1="{a}" site2="{b}"/>' for a, b in loops)
    gear = 1 / (1 + (np.zeros(drives) if build.gain is None else build.gain))
    motors = "".join(
        f'<position joint="q{i + 1}" kp="{float(k)!r}" gear="{float(g)!r}"/>'
        for i, (k, g) in enumerate(zip(servo, gear, strict=True))
    )
    hook, tendons = "", ""
    if build.stop is not None:
        joint, begin, side, stiffness = build.stop
        # A spring with a dead band: it pushes back beyond the stop alone.
        band = (-100.0, begin) if side > 0 else (begin, 100.0)
        tendons += f'<fixed springlength="{numbers(band)}" stiffness="{stiffness!r}">'
        tendons += f'<joint joint="q{joint + 1}" coef="1"/></fixed>'
    if build.cable is not None:
        point, stiffness, slack = build.cable
        hook = f'<site name="hook" pos="{numbers(point)}"/>'
        tendons += f'<spatial springlength="0 {slack!r}" stiffness="{stiffness!r}">'
        tendons += '<site site="hook"/><site site="tool"/></spatial>'
    base = placed(build.base[:3], Rotation.from_rotvec(build.base[3:]))
    return (
        f'<mujoco><compiler angle="radian" autolimits="false"/><option gravity="{numbers(weight)}" jacobian="dense"/>'
        f'<worldbody>{hook}<body name="base" {base}>{bodies}</body></worldbody>'
        f"<equality>{closed}</equality><tendon>{tendons}</tendon><actuator>{motors}</actuator></mujoco>"
    )
