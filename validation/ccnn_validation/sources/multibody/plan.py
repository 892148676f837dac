"""A cause as a change of a MuJoCo model, and the poses of a machine that has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.case import Truth
from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build
from ccnn_validation.sources.multibody.design import Design
from ccnn_validation.sources.multibody.equilibrium import settle
from ccnn_validation.sources.multibody.machine import Machine

__all__ = ["Plan", "gap", "joined", "poses"]

_FRAME = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Plan:
    """A cause.

    Attributes:
        build: the machine as built, of a strength (1 = usual).
        truth: what is right.
        columns: covariates that show it: load, temperature, time, direction, speed.
        growth: share by which lengths grow, [1/K] at strength 1; 0 = none.
        screws: the drives' scales grow as well.
        softening: share by which drives soften [1/K].
        after: the first row that the machine is as in `build`; before it is nominal.
        sizes: least and largest root mean square of the error in units of the noise.
        plain: loads would have no effect, and may be added as columns without any.
    """

    build: Callable[[float], Build]
    truth: Truth
    columns: frozenset[str] = field(default_factory=frozenset)
    growth: float = 0.0
    screws: bool = False
    softening: float = 0.0
    after: int = 0
    sizes: tuple[float, float] = (5.0, 40.0)
    plain: bool = True


def poses(machine: Machine, plan: Plan, strength: float, design: Design) -> Array:
    """Measured coordinates without noise, `s x p` [m, rad]."""
    model = machine.compiled(plan.build(strength))
    rest = settle(
        model,
        design.joints,
        machine.begin(model, design.joints, design.pose),
        design.load if "load" in plan.columns else None,
        design.direction,
        design.speed,
        _changing(model, plan, strength, design),
    )
    turn = Rotation.from_matrix(rest.rotation).as_rotvec()
    measured = np.hstack([rest.position, turn])[:, [_FRAME.index(c) for c in machine.pose]]
    if machine.turns:
        # Of the two vectors of a rotation by nearly half a turn, the one that is near the nominal pose.
        measured[:, 3:] = _near(measured[:, 3:], design.pose[:, 3:])
    return np.where(np.arange(len(measured))[:, None] < plan.after, design.pose, measured)


def gap(machine: Machine, measured: Array, nominal: Array) -> Array:
    """Error of poses, `s x p`: positions, and the small rotation that turns the nominal platform [m, rad]."""
    if not machine.turns:
        return measured - nominal
    turn = (Rotation.from_rotvec(measured[:, 3:]) * Rotation.from_rotvec(nominal[:, 3:]).inv()).as_rotvec()
    return np.hstack([measured[:, :3] - nominal[:, :3], turn])


def joined(plans: tuple[Plan, Plan], strengths: tuple[float, float], truth: Truth) -> Plan:
    """Both causes at once, each at its own strength, as a plan of strength 1."""

    def build(strength: float) -> Build:
        first, second = (plan.build(size * strength) for plan, size in zip(plans, strengths, strict=True))
        plain = Build()
        changed = {f.name: getattr(second, f.name) for f in fields(Build) if f.name in _differing(second, plain)}
        return replace(first, **changed)

    return Plan(
        build=build,
        truth=truth,
        columns=plans[0].columns | plans[1].columns,
        growth=sum(plan.growth * size for plan, size in zip(plans, strengths, strict=True)),
        screws=any(plan.screws for plan in plans),
        plain=all(plan.plain for plan in plans),
    )


def _differing(build: Build, plain: Build) -> set[str]:
    """Names of what differs from the nominal machine."""
    pairs = ((f.name, getattr(build, f.name), getattr(plain, f.name)) for f in fields(Build))
    return {name for name, now, before in pairs if now is not None and (before is None or now != before)}


def _near(turn: Array, wanted: Array) -> Array:
    """Rotation vectors `s x 3` as those of the same rotation that are nearest to others [rad]."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    other = turn * (1 - 2 * np.pi / np.maximum(angle, 1e-9))
    nearer = np.linalg.norm(turn - wanted, axis=1) <= np.linalg.norm(other - wanted, axis=1)
    return np.where(nearer[:, None], turn, other)


def _changing(model: mujoco.MjModel, plan: Plan, strength: float, design: Design) -> Callable[[int], None] | None:
    """What changes the model to that of a row's temperature."""
    if not plan.growth and not plan.softening:
        return None
    bodies, sites, gear = model.body_pos.copy(), model.site_pos.copy(), model.actuator_gear.copy()
    gain, bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
    warm = design.temperature - 20
    sliding = model.jnt_type[model.actuator_trnid[:, 0]] == mujoco.mjtJoint.mjJNT_SLIDE

    def vary(row: int) -> None:
        larger = 1 + plan.growth * strength * warm[row]
        model.body_pos[:], model.site_pos[:] = bodies * larger, sites * larger
        if plan.screws:
            model.actuator_gear[sliding] = gear[sliding] / larger
        softer = 1 / (1 + plan.softening * warm[row])
        model.actuator_gainprm[:], model.actuator_biasprm[:] = gain * softer, bias * softer

    return vary
