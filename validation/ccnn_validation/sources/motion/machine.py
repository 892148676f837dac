"""MuJoCo models: a pendulum on one servo, and an arm of six axes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["Axis", "arm_xml", "drawn_axis", "pendulum_xml"]


@dataclass(frozen=True)
class Axis:
    """One servo with a load at the end of a massless lever; SI units.

    Attributes:
        mass, length: of the load.
        armature, damping, dry: of the joint: kg m^2, N m s/rad, N m.
        kp: position gain [N m/rad].
        force: limit of the motor's torque [N m]; 0 = none.
        tilt: of the gravity vector in the plane of the motion [rad].
        integral: integral gain over the proportional one [1/s]; 0 = none.
        play, spring: width of a play and stiffness of a spring behind the motor; 0 = none.
    """

    mass: float
    length: float
    armature: float
    damping: float
    dry: float
    kp: float
    force: float = 0.0
    tilt: float = 0.0
    integral: float = 0.0
    play: float = 0.0
    spring: float = 0.0
    extra: dict[str, float] = field(default_factory=dict)


def drawn_axis(generator: np.random.Generator) -> Axis:
    """A servo of some Nm: closed loop of 3 to 8 Hz, damping ratio 0.4 to 1, sag of up to 0.1 rad."""
    mass, length = generator.uniform(0.3, 1.2), generator.uniform(0.08, 0.25)
    armature = generator.uniform(0.1, 0.5) * mass * length**2
    inertia = armature + mass * length**2
    frequency, ratio = generator.uniform(3.0, 8.0), generator.uniform(0.4, 1.0)
    kp = inertia * (2 * np.pi * frequency) ** 2
    damping = 2 * ratio * np.sqrt(kp * inertia)
    dry = generator.uniform(0.0, 0.01) * kp
    return Axis(float(mass), float(length), float(armature), float(damping), float(dry), float(kp))


def pendulum_xml(axis: Axis) -> str:
    """The model; q = 0: the load hangs down."""
    force = f'forcelimited="true" forcerange="{-axis.force} {axis.force}"' if axis.force else ""
    gx, gz = -9.80665 * np.sin(axis.tilt), -9.80665 * np.cos(axis.tilt)
    load = f'<geom type="sphere" size="0.01" pos="0 0 {-axis.length}" mass="{axis.mass}"/>'
    if axis.play or axis.spring:
        # The motor's side carries the armature, and a body that MuJoCo needs; the load is behind a second hinge.
        second = (
            f'<joint name="far" axis="0 1 0" limited="true" range="{-axis.play / 2} {axis.play / 2}" '
            'solreflimit="0.004 1" damping="0.0005"/>'
            if axis.play
            else f'<joint name="far" axis="0 1 0" stiffness="{axis.spring}" '
            f'damping="{axis.extra.get("spring_damping", 0.0)}"/>'
        )
        load = f'<geom type="sphere" size="0.01" mass="0.001"/><body>{second}{load}</body>'
    return f"""<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.0005" integrator="implicitfast" gravity="{gx} 0 {gz}"/>
  <worldbody>
    <body>
      <joint name="q1" axis="0 1 0" armature="{axis.armature}" damping="{axis.damping}" frictionloss="{axis.dry}"/>
      {load}
    </body>
  </worldbody>
  <actuator><position joint="q1" kp="{axis.kp}" {force}/></actuator>
</mujoco>
"""


def arm_xml(dry: tuple[float, ...] = (0.0,) * 6, play: tuple[float, ...] = (0.0,) * 6) -> str:
    """An arm of six axes; dry friction [N m], and width of a play behind each motor [rad]."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
    offsets = ("0 0 0.1", "0 0 0.1", "0 0 0.3", "0 0 0.25", "0 0 0.1", "0 0 0.08")
    masses, armatures = (3.0, 2.5, 1.5, 0.8, 0.5, 0.3), (0.3, 0.3, 0.2, 0.05, 0.05, 0.03)
    kps = (1500.0, 2500.0, 1200.0, 250.0, 200.0, 100.0)
    body = ""
    for i in reversed(range(6)):
        inner = f'<geom type="capsule" fromto="0 0 0 0 0 0.08" size="0.02" mass="{masses[i]}"/>{body}'
        if play[i]:
            inner = (
                '<geom type="sphere" size="0.01" mass="0.01"/>'
                f'<body><joint name="far{i + 1}" axis="{axes[i]}" limited="true" range="{-play[i] / 2} {play[i] / 2}" '
                f'solreflimit="0.004 1" damping="0.005"/>{inner}</body>'
            )
        damping = 2 * 0.8 * np.sqrt(kps[i] * armatures[i])
        body = (
            f'<body pos="{offsets[i]}"><joint name="q{i + 1}" axis="{axes[i]}" armature="{armatures[i]}" '
            f'damping="{damping:.6g}" frictionloss="{dry[i]}"/>{inner}</body>'
        )
    actuators = "".join(f'<position joint="q{i + 1}" kp="{kps[i]}"/>' for i in range(6))
    return f"""<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>{body}</worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
