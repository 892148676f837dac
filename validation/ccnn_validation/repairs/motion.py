"""Public repairs of what moves a joint, replayed in MuJoCo: logs of the repaired axis, by the model before it.

One axis with the loads that hang on it in the published model stands for the robot: the repairs are of one joint's
numbers, and all axes of a class got the same ones.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ccnn_torch.api import diagnose_motion
from ccnn_validation.delivered.rotation import Array

STEP, SAMPLES, SECONDS = 1e-3, 5, 8.0
"""Of the simulation [s], steps for each sample of the log, and length of a run [s]."""
NOISE = 2e-4
"""Of the encoder [rad]."""
HELD_OUT = 3
"""The motion that no diagnosis sees."""


@dataclass(frozen=True)
class Axis:
    """One axis of a MuJoCo model; SI.

    Attributes:
        armature, damping, friction: of the joint.
        kp, kv, force: of its position actuator; no limit where force is 0.
        loads: mass and distance below the axis.
        inertia: of a body that turns about a vertical axis, in the place of loads.
    """

    armature: float
    damping: float
    friction: float
    kp: float
    kv: float
    force: float = 0.0
    loads: tuple[tuple[float, float], ...] = ()
    inertia: float = 0.0

    def xml(self) -> str:
        """The model."""
        force = f'forcerange="{-self.force} {self.force}"' if self.force else ""
        body = "".join(f'<geom type="sphere" size="0.005" pos="0 0 {-far}" mass="{mass}"/>' for mass, far in self.loads)
        if self.inertia:
            body = f'<inertial pos="0 0 0" mass="60" diaginertia="{self.inertia} {self.inertia} {self.inertia}"/>'
        axis = "0 0 1" if self.inertia else "0 1 0"
        joint = f'armature="{self.armature}" damping="{self.damping}" frictionloss="{self.friction}"'
        return (
            f'<mujoco><compiler angle="radian"/><option timestep="{STEP}" integrator="implicitfast"/>'
            f'<worldbody><body><joint name="q1" axis="{axis}" {joint}/>{body}</body></worldbody>'
            f'<actuator><position joint="q1" kp="{self.kp}" kv="{self.kv}" {force}/></actuator></mujoco>'
        )


@dataclass(frozen=True)
class MotionRepair:
    """A repair: name, source and what people found as in `Repair`; the axis before it, what it changed, and the names
    that are right."""

    name: str
    source: str
    found: str
    old: Axis
    new: dict[str, Any]
    right: tuple[str, ...]

    @property
    def repaired(self) -> Axis:
        """The axis after it."""
        return replace(self.old, **self.new)


@dataclass
class MotionReplay:
    """What the diagnosis said, and RMS difference of model and machine in a motion that it did not see [mrad], before
    and with its numbers typed into the model; NaN where a number has no place in the file."""

    repair: MotionRepair
    content: dict[str, Any]
    before: float
    typed: float
    seconds: float
    numbers: list[str] = field(default_factory=list)

    @property
    def outcome(self) -> str:
        """`all names`, `a class` that holds them, `some names`, `one name too many`, or `no`."""
        verdict = self.content["verdict"]
        named, right = set(verdict["effects"]), set(self.repair.right)
        like = {n for e in self.content["effects"] if e["name"] in named for n in e["indistinguishable_from"]}
        if named == right:
            return "all names"
        if len(named) == len(right) and right <= named | like:
            return "a class"
        if right <= named:
            return "one name too many"
        return "some names" if named and named <= right else "no"


def commands(t: Array, motion: int) -> Array:
    """A chirp, steps, slow reversals, and the motion that is held out [rad]."""
    if motion == 0:
        return np.asarray(0.6 * np.sin(2 * np.pi * (0.2 * t + 0.175 * t**2)))
    if motion == 1:
        return np.asarray(np.array([0, 0.48, -0.36, 0.18, -0.6, 0.3, 0.6, 0])[np.minimum(t.astype(int), 7)])
    if motion == 2:
        return np.asarray(1.2 / np.pi * np.arcsin(np.sin(0.6 * np.pi * t)))
    return np.asarray(0.42 * np.sin(1.4 * np.pi * t) + 0.17 * np.sin(4.2 * np.pi * t + 1))


def run(axis: Axis, motion: int) -> tuple[Array, Array, Array]:
    """Time, commands and positions of one run."""
    model = mujoco.MjModel.from_xml_string(axis.xml())
    data = mujoco.MjData(model)
    t: Array = STEP * np.arange(round(SECONDS / STEP), dtype=np.float64)
    sent: Array = np.interp(t, t[::SAMPLES], commands(t[::SAMPLES], motion))
    data.qpos[0] = sent[0]
    found: Array = np.empty_like(t)
    for i, command in enumerate(sent):
        found[i] = data.qpos[0]
        data.ctrl[0] = command
        mujoco.mj_step(model, data)
    return t[::SAMPLES], sent[::SAMPLES], found[::SAMPLES]


def replayed_motion(repair: MotionRepair, folder: Path, seed: int = 0) -> MotionReplay:
    """The verdict on logs of a repaired axis, and what its numbers are worth in the model before the repair."""
    rng, files = np.random.default_rng(seed), []
    for motion in range(HELD_OUT):
        rows = np.stack(run(repair.repaired, motion), -1)
        rows[:, 2] += rng.normal(0, NOISE, len(rows))
        files.append(folder / f"run{motion}.csv")
        np.savetxt(files[-1], rows, "%.7f", ",", header="time[s],command1[rad],q1[rad]", comments="")
    model = folder / "old.xml"
    model.write_text(repair.old.xml())
    start = time.perf_counter()
    content = diagnose_motion(motion=[str(f) for f in files], mechanism=str(model), network=False, seed=seed).content
    seconds = time.perf_counter() - start
    truth = run(repair.repaired, HELD_OUT)[2]

    def rms(axis: Axis) -> float:
        return float(1e3 * np.sqrt(np.mean((run(axis, HELD_OUT)[2] - truth) ** 2)))

    told = [e for e in content["effects"] if e["name"] in content["verdict"]["effects"]]
    changed = typed_in(repair.old, told)
    numbers = [
        f"{name.removeprefix('q1 ')} {block['value']:.4g} ± {1.96 * block['sd']:.2g} {block['unit']}"
        for effect in told
        for name, block in effect["parameters"].items()
        if block["sd"]
    ]
    typed = float("nan") if changed is None else rms(changed)
    return MotionReplay(repair, dict(content), rms(repair.old), typed, seconds, numbers)


def typed_in(axis: Axis, effects: list[dict[str, Any]]) -> Axis | None:
    """The model with the numbers of a verdict in it, to four digits; None where one has no place in the file."""
    for effect in effects:
        for name, block in effect["parameters"].items():
            number, word = float(f"{block['value']:.4g}"), name.removeprefix("q1 ")
            if word == "inertia":
                axis = replace(axis, armature=max(axis.armature + number, 0.0))
            elif word == "viscous":
                axis = replace(axis, damping=max(axis.damping + number, 0.0))
            elif word == "coulomb":
                axis = replace(axis, friction=max(axis.friction + number, 0.0))
            elif word == "proportional gain" and block["unit"] == "1":
                axis = replace(axis, kp=axis.kp * (1 + number))
            elif word == "payload":
                axis = replace(axis, loads=(*axis.loads, (number, axis.loads[-1][1])))
            else:
                return None
    return axis


_PI_ARM = Axis(0.008419, 0.66, 0.0, 30, 0.6, 10, ((0.313175, 0.0037), (0.0751806, 0.0698)))
_PI_LEG = Axis(0.044277, 2.94, 0.0, 35, 1.1, 20, ((0.858523, 0.0667), (0.163526, 0.14), (0.616626, 0.155)))
_SO101 = Axis(0.028, 0.6, 0.052, 17.8, 0.0, 3.35, ((0.104, 0.0981), (0.178, 0.165)))
MOTION_REPAIRS = (
    MotionRepair(
        "Pi Plus, elbow",
        "bit-bots/bitbots_main PR 906",
        "dry friction is missing and the armature too small",
        _PI_ARM,
        {"armature": 0.01317, "friction": 0.2},
        ("coulomb", "inertia"),
    ),
    MotionRepair(
        "Pi Plus, knee",
        "bit-bots/bitbots_main 35bf49593",
        "damping is twice, armature three times too large",
        _PI_LEG,
        {"armature": 0.01316, "damping": 1.5},
        ("viscous", "inertia"),
    ),
    MotionRepair(
        "SO-101, elbow",
        "TheRobotStudio/SO-ARM100 PR 141",
        "the position gain is 56 times too small, and its damping is missing",
        _SO101,
        {"kp": 998.22, "kv": 2.731, "force": 2.94},
        ("servo_gain",),
    ),
    MotionRepair(
        "TidyBot, base",
        "google-deepmind/mujoco_menagerie PR 307",
        "the yaw inertia of 0.001 kg m² is a placeholder",
        Axis(0.0, 0.0, 0.0, 50000, 1000, inertia=0.001),
        {"inertia": 1.213058},
        ("inertia",),
    ),
    MotionRepair(
        "UR5e, elbow",
        "UniversalRobots/Universal_Robots_ROS2_Description PR 187",
        "forearm and wrists are 0.98 kg too light",
        Axis(0.1, 0.0, 0.0, 2000, 400, 150, ((2.275, 0.11993), (2.6259, 0.3922))),
        {"loads": ((2.846, 0.11993), (3.035, 0.3922))},
        ("payload",),
    ),
)
