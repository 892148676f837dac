"""From plans to measured rows: causes scaled to their strength in the true kinematics, then noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ccnn_validation.blind.body_causes import BODY_CAUSES
from ccnn_validation.blind.case import (
    CAUSES_STREAM,
    CONDITIONS_STREAM,
    NOISE_STREAM,
    BlindCase,
    displaced,
    draw_noise,
    gap,
)
from ccnn_validation.blind.conditions import Conditions, draw_conditions
from ccnn_validation.blind.deviation import Deviation, measured_pose, stack, weighted
from ccnn_validation.blind.drivers import own_drivers
from ccnn_validation.blind.joint_causes import JOINT_CAUSES
from ccnn_validation.blind.machines import BlindMachine, blind_machine
from ccnn_validation.blind.mujoco_case import mujoco_case
from ccnn_validation.blind.outside_causes import outside_cause
from ccnn_validation.blind.plan import CasePlan

__all__ = ["LEVER", "simulate"]

LEVER = 0.3
"""Distance of the points that determine orientation [m]: the noise of an angle is that of a length over this."""
_ROUNDS, _ROUGH = 5, 2


def simulate(plans: Sequence[CasePlan], seed: int) -> list[BlindCase]:
    """Simulate cases; those of one machine and one number of rows together. In the order given."""
    groups: dict[tuple[str, int], list[CasePlan]] = {}
    for plan in plans:
        groups.setdefault((plan.machine, plan.rows), []).append(plan)
    found: dict[int, BlindCase] = {}
    machines: dict[str, BlindMachine] = {}
    for (name, _), members in groups.items():
        if name == "mujoco_five_bar":
            found |= {plan.number: mujoco_case(plan, seed) for plan in members}
            continue
        machine = machines.setdefault(name, blind_machine(name))
        found |= {case.plan.number: case for case in _group(machine, members, seed)}
    return [found[plan.number] for plan in plans]


def _group(machine: BlindMachine, plans: Sequence[CasePlan], seed: int) -> list[BlindCase]:
    """Cases of one machine with equally many rows."""

    def generator(plan: CasePlan, stream: int) -> np.random.Generator:
        return np.random.default_rng([seed, plan.number, stream])

    at = [draw_conditions(machine, p.rows, p.moving, generator(p, CONDITIONS_STREAM)) for p in plans]
    drawn = [_causes(machine, p, a, generator(p, CAUSES_STREAM)) for p, a in zip(plans, at, strict=True)]
    joints, pose = (torch.stack([getattr(a, name) for a in at]) for name in ("joints", "pose"))
    sd = torch.stack([_spread(machine, p) for p in plans])
    shares = torch.tensor([[*p.shares, 0.0, 0.0][:2] for p in plans], dtype=torch.float64)
    strength = torch.tensor([p.strength for p in plans], dtype=torch.float64)
    parts = stack([d for d, _ in drawn])
    size = _sizes(machine, joints, pose, parts, shares * strength[:, None], strength, sd)
    true = measured_pose(machine, joints, pose, weighted(parts, size))
    cases = []
    for i, plan in enumerate(plans):
        step, bad = draw_noise(plan, sd[i], generator(plan, NOISE_STREAM))
        cases.append(
            BlindCase(
                plan=plan,
                machine=machine,
                joints=joints[i],
                pose=pose[i],
                true=true[i],
                measured=displaced(machine, true[i], step),
                columns=at[i].columns(machine),
                sd=sd[i],
                drivers=drawn[i][1],
                bad=bad,
            )
        )
    return cases


def _causes(
    machine: BlindMachine, plan: CasePlan, at: Conditions, generator: np.random.Generator
) -> tuple[Deviation, tuple[tuple[str, ...], ...]]:
    """Up to two causes side by side, `2 x …`, and the drivers of each."""
    makers = {**JOINT_CAUSES, **BODY_CAUSES}
    if plan.kind == "outside":
        wrong, driver = outside_cause(plan.causes[0], machine, at, generator)
        return stack([wrong, Deviation.none(machine, plan.rows)]), (driver,)
    found = [makers[cause](machine, at, generator) for cause in plan.causes if cause in makers]
    drivers = tuple(own_drivers(cause, wrong, machine) for cause, wrong in zip(plan.causes, found, strict=False))
    return stack([*found, *[Deviation.none(machine, plan.rows)] * (2 - len(found))]), drivers


def _sizes(
    machine: BlindMachine, joints: Tensor, pose: Tensor, parts: Deviation, alone: Tensor, together: Tensor, sd: Tensor
) -> Tensor:
    """Factors of the causes, `r x e`: each alone as strong as `alone` asks (`r x e`), then all as `together` (`r`).

    Strength is nearly proportional to the factor: a few proportional corrections reach it.
    """
    size = (alone > 0) * 1e-5
    for cause in range(alone.shape[1]):
        mask = torch.zeros_like(size)
        mask[:, cause] = 1.0
        for _ in range(_ROUGH):
            size = size * (1 - mask) + mask * size * _ratio(
                alone[:, cause], _strength(machine, joints, pose, weighted(parts, size * mask), sd)
            )
    for _ in range(_ROUNDS):
        size = size * _ratio(together, _strength(machine, joints, pose, weighted(parts, size), sd))
    return size


def _ratio(wanted: Tensor, there: Tensor) -> Tensor:
    """`r x 1`; 0 where nothing is wanted."""
    return torch.where(wanted > 0, wanted / there.clamp_min(1e-12), 0.0)[:, None]


def _strength(machine: BlindMachine, joints: Tensor, pose: Tensor, wrong: Deviation, sd: Tensor) -> Tensor:
    """RMS of the gap over rows and pose coordinates in units of the noise, `r`."""
    off = gap(machine, measured_pose(machine, joints, pose, wrong), pose)
    return (off / sd[:, None]).square().mean((-1, -2)).sqrt()


def _spread(machine: BlindMachine, plan: CasePlan) -> Tensor:
    """Standard deviation of the noise of each pose coordinate, `p` [SI]."""
    lengths = torch.tensor([c.unit == "m" for c in machine.mechanism.pose])
    sd = torch.where(lengths, plan.noise, plan.noise / LEVER).to(torch.float64)
    if plan.disturbance == "uneven noise":
        # Half as much and twice as much by turns.
        sd = sd * torch.tensor([0.5 if i % 2 else 2.0 for i in range(len(sd))], dtype=torch.float64)
    return sd
