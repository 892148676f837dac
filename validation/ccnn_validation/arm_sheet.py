"""The data sheet of the judged arm, as numbers, as keys of the servo and as MJCF."""

from __future__ import annotations

import numpy as np

G = 9.81
# By the data sheet. Links: lengths [m], masses [kg], centres [m], inertias about those [kg m²]; base; load [kg].
L2, L3, M2, M3, C2, C3, I2, I3, BASE, LOAD = 0.40, 0.42, 6.0, 5.5, 0.18, 0.15, 0.09, 0.08, 0.15, 2.0
# Drives, at the joints: gain [N m/rad, N m s/rad], shares of speed and weight that are fed forward, delay [s], inertia
# [kg m²], dry friction, more of it at rest [N m], viscous [N m s/rad], stiffness of the gears [N m/rad].
KP, KD, FORWARD, BALANCE, DELAY = np.array([6000.0, 6000, 2200]), np.array([220.0, 220, 70]), 0.8, 0.8, 4e-3
MOTOR, DRY, REST = np.array([0.6, 0.6, 0.25]), np.array([8.0, 8, 4]), np.array([1.5, 1.5, 0.8])
WET, STIFF = np.array([12.0, 12, 5]), np.array([25e3, 25e3, 10e3])
# Joints are measured around this place, as far as that [rad].
PLACE, REACH = np.array([0.0, 0.78, -1.3]), np.array([0.9, 0.5, 0.55])


def keys() -> str:
    """The data sheet as keys of the servo, other joints where they are in the middle; how well they are known."""
    c3, out2, out3 = np.cos(PLACE[2]), M2 * C2 + (M3 + LOAD) * L2, M3 * C3 + LOAD * L3
    whole3 = I3 + M3 * C3**2 + LOAD * L3**2
    whole2 = I2 + M2 * C2**2 + (M3 + LOAD) * L2**2 + 2 * L2 * out3 * c3 + whole3
    low, high = np.cos(PLACE[1]), np.cos(PLACE[1] + PLACE[2])
    whole1 = BASE + (I2 + M2 * C2**2 + (M3 + LOAD) * L2**2) * low**2 + 2 * L2 * out3 * low * high + whole3 * high**2
    links, rest = np.array([whole1, whole2, whole3]), G * (1 - BALANCE)
    values = {
        "gain": KP, "derivative": FORWARD * KD / KP, "inertia": links + MOTOR, "load_inertia": links,
        "viscous": WET + KD * (1 - FORWARD), "coulomb": DRY, "stribeck": REST, "stribeck_speed": np.full(3, 0.05),
        "gravity_cos": rest * np.array([0, out2 + out3 * c3, out3 * np.cos(PLACE[1])]),
        "gravity_sin": rest * np.array([0, -out3 * np.sin(PLACE[2]), out3 * np.sin(PLACE[1])]),
        "flexibility": links / STIFF, "flexible_damping": np.full(3, 0.05), "delay": np.full(3, DELAY),
    }  # fmt: skip
    told = ", ".join(f"{name}: [{', '.join(f'{x:.5g}' for x in value)}]" for name, value in values.items())
    known = "gain: 10 %, derivative: 20 %, inertia: 25 %, viscous: 40 %, coulomb: 40 %, stribeck: 50 %, delay: 50 %"
    return f"mechanism_keys: {{{told}}}\nknown: {{{known}}}\n"


def mjcf() -> str:
    """The data sheet as MJCF; speed that is fed forward lessens the drive's own damping, weight that is, the weight."""
    drive = [f'armature="{m}" damping="{w}" frictionloss="{d}"' for m, w, d in zip(MOTOR, WET, DRY, strict=True)]
    boxes = []
    for mass, centre, about in ((M2, C2, I2), (M3, C3, I3)):
        size = f"{np.sqrt(3 * about / mass - 0.049**2):.6g} 0.049 0.049"
        boxes.append(f'<geom type="box" size="{size}" pos="{centre} 0 0" mass="{mass}" contype="0" conaffinity="0"/>')
    drum = f'<geom type="sphere" size="{np.sqrt(BASE / 4 * 2.5):.6g}" mass="4" contype="0" conaffinity="0"/>'
    motors = "".join(f'<position joint="j{k + 1}" kp="{KP[k]}" kv="{KD[k] * (1 - FORWARD):g}"/>' for k in range(3))
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body name="base">{drum}<joint name="j1" axis="0 0 1" {drive[0]}/>
<body name="upper" gravcomp="{BALANCE}">{boxes[0]}<joint name="j2" axis="0 -1 0" {drive[1]}/>
<body name="fore" pos="{L2} 0 0" gravcomp="{BALANCE}">{boxes[1]}<joint name="j3" axis="0 -1 0" {drive[2]}/>
<body name="load" pos="{L3} 0 0" gravcomp="{BALANCE}"><geom type="sphere" size="0.03" mass="{LOAD}" contype="0"
 conaffinity="0"/><site name="tool"/></body></body></body></body></worldbody><actuator>{motors}</actuator></mujoco>
"""
