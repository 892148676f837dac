"""Blind cases of the five-bar in MuJoCo: the causes are its servos, masses, friction and dimensions themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_validation.blind.case import (
    CAUSES_STREAM,
    CONDITIONS_STREAM,
    NOISE_STREAM,
    BlindCase,
    displaced,
    draw_noise,
)
from ccnn_validation.blind.conditions import draw_conditions
from ccnn_validation.blind.machines import BlindMachine, blind_machine
from ccnn_validation.blind.mujoco_five_bar import Servo, settled
from ccnn_validation.blind.plan import CasePlan

__all__ = ["mujoco_case"]

_STIFFNESS = (1e5, 6e5)
_FRICTION = (3.0, 15.0)
_TOLERANCE, _ZERO = 2e-4, 3e-4
"""Standard deviations of lengths [m] and of encoder zeros [rad]."""


def mujoco_case(plan: CasePlan, seed: int) -> BlindCase:
    """Simulate and measure one case. The noise is scaled so that the gap has the planned strength.

    Without compliance there is no load: servos are never rigid.
    """
    machine = blind_machine(plan.machine)
    at = draw_conditions(machine, plan.rows, False, np.random.default_rng([seed, plan.number, CONDITIONS_STREAM]))
    g = np.random.default_rng([seed, plan.number, CAUSES_STREAM])
    acts = {cause: cause in plan.causes for cause in ("joint_offset", "compliance", "gravity", "friction", "geometry")}
    stiffness = float(np.exp(g.uniform(*np.log(_STIFFNESS))))
    friction = g.uniform(*_FRICTION, 2) * acts["friction"]
    servo = Servo(
        stiffness=stiffness,
        friction=(float(friction[0]), float(friction[1])),
        payload=float(g.uniform(1.0, 4.0)),
        weight=acts["gravity"],
    )
    lengths = torch.tensor([p.unit == "m" for p in machine.mechanism.geometry])
    built = machine.mechanism.nominal + torch.as_tensor(g.normal(0, _TOLERANCE, 12)) * lengths * acts["geometry"]
    zero = torch.as_tensor(g.normal(0, _ZERO, 2)) * acts["joint_offset"]
    load = at.load * acts["compliance"]
    true = settled(servo, built, at.joints + zero, at.direction, load)[0]
    sd = torch.full((2,), plan.noise, dtype=torch.float64)
    if plan.strength > 0:
        sd = ((true - at.pose).square().mean().sqrt() / plan.strength).expand(2)
    step, bad = draw_noise(plan, sd, np.random.default_rng([seed, plan.number, NOISE_STREAM]))
    return BlindCase(
        plan=replace(plan, noise=float(sd[0])),
        machine=machine,
        joints=at.joints,
        pose=at.pose,
        true=true,
        measured=displaced(machine, true, step),
        columns=_columns(at.columns(machine), acts["compliance"]),
        sd=sd,
        drivers=tuple(_driver(cause, machine) for cause in plan.causes),
        bad=bad,
    )


def _columns(columns: dict[Coordinate, Tensor], loaded: bool) -> dict[Coordinate, Tensor]:
    return {c: values for c, values in columns.items() if loaded or not c.name.startswith("load_")}


def _driver(cause: str, machine: BlindMachine) -> tuple[str, ...]:
    if cause == "compliance":
        return tuple(f"load {c.name}" for c in machine.mechanism.pose)
    return ("direction 1", "direction 2") if cause == "friction" else ()
