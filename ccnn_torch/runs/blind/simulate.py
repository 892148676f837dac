"""From plans to measured rows: causes scaled to their strength in the true kinematics, then noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.runs.blind.body_causes import BODY_CAUSES
from ccnn_torch.runs.blind.conditions import Conditions, draw_conditions
from ccnn_torch.runs.blind.deviation import Deviation, measured_pose, stack, weighted
from ccnn_torch.runs.blind.drivers import own_drivers
from ccnn_torch.runs.blind.joint_causes import JOINT_CAUSES
from ccnn_torch.runs.blind.machines import BlindMachine, blind_machine
from ccnn_torch.runs.blind.outside_causes import outside_cause
from ccnn_torch.runs.blind.plan import CasePlan

__all__ = ["LEVER", "BlindCase", "displaced", "gap", "simulate"]

LEVER = 0.3
"""Distance of the points that orientation is measured by [m]: an angle has the noise of a length over this."""
_ROUNDS, _ROUGH = 5, 2
_BAD = (0.02, 0.05)
"""Share of bad rows; each is off by 20 to 200 times the noise."""
_CONDITIONS, _CAUSES, _NOISES = 1, 2, 3


@dataclass(frozen=True)
class BlindCase:
    """A case with everything about it; what the diagnoser is given is `joints`, `measured`, `columns`, `sd` if told.

    Attributes:
        true: pose without noise, `s x p` [SI].
        sd: standard deviation of the noise of each pose coordinate, `p` [SI].
        drivers: of each cause, as a verdict may name them where it says that no effect fits; () where it has none of
            its own.
        bad: rows that are off, 0-based.
    """

    plan: CasePlan
    machine: BlindMachine
    joints: Tensor
    pose: Tensor
    true: Tensor
    measured: Tensor
    columns: dict[Coordinate, Tensor]
    sd: Tensor
    drivers: tuple[tuple[str, ...], ...]
    bad: tuple[int, ...]


def simulate(plans: Sequence[CasePlan], seed: int) -> list[BlindCase]:
    """Simulate cases; those of one machine and one number of rows together. In the order given."""
    groups: dict[tuple[str, int], list[CasePlan]] = {}
    for plan in plans:
        groups.setdefault((plan.machine, plan.rows), []).append(plan)
    found: dict[int, BlindCase] = {}
    machines: dict[str, BlindMachine] = {}
    for (name, _), members in groups.items():
        machine = machines.setdefault(name, blind_machine(name))
        found |= {case.plan.number: case for case in _group(machine, members, seed)}
    return [found[plan.number] for plan in plans]


def _group(machine: BlindMachine, plans: Sequence[CasePlan], seed: int) -> list[BlindCase]:
    """Cases of one machine with equally many rows."""
    at = [
        draw_conditions(machine, p.rows, p.moving, np.random.default_rng([seed, p.number, _CONDITIONS])) for p in plans
    ]
    drawn = [
        _causes(machine, p, a, np.random.default_rng([seed, p.number, _CAUSES])) for p, a in zip(plans, at, strict=True)
    ]
    joints, pose = (torch.stack([getattr(a, name) for a in at]) for name in ("joints", "pose"))
    sd = torch.stack([_spread(machine, p) for p in plans])
    shares = torch.tensor([[*p.shares, 0.0, 0.0][:2] for p in plans], dtype=torch.float64)
    strength = torch.tensor([p.strength for p in plans], dtype=torch.float64)
    parts = stack([d for d, _ in drawn])
    size = _sizes(machine, joints, pose, parts, shares * strength[:, None], strength, sd)
    true = measured_pose(machine, joints, pose, weighted(parts, size))
    cases = []
    for i, plan in enumerate(plans):
        step, bad = _noise(plan, sd[i], np.random.default_rng([seed, plan.number, _NOISES]))
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

    Strength is nearly proportional to the factor: a few rounds of the rule of three bring it there.
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


def _noise(plan: CasePlan, sd: Tensor, generator: np.random.Generator) -> tuple[Tensor, tuple[int, ...]]:
    """Displacements `s x p` [SI] and the bad rows among them."""
    unit = generator.standard_normal((plan.rows, len(sd)))
    if plan.disturbance == "heavy tails":
        # Student's t with 4 degrees of freedom, of variance 1, one draw for a whole row.
        unit *= np.sqrt(2 / generator.chisquare(4, (plan.rows, 1)))
    bad: tuple[int, ...] = ()
    if plan.disturbance == "bad rows" or plan.causes == ("outlier",):
        count = max(2, round(plan.rows * generator.uniform(*_BAD)))
        rows = np.sort(generator.permutation(plan.rows)[:count])
        way = generator.standard_normal((count, len(sd)))
        way *= np.sqrt(len(sd)) / np.linalg.norm(way, axis=1, keepdims=True)
        unit[rows] += way * np.exp(generator.uniform(np.log(20), np.log(200), (count, 1)))
        bad = tuple(rows.tolist())
    return torch.as_tensor(unit) * sd, bad


def gap(machine: BlindMachine, there: Tensor, here: Tensor) -> Tensor:
    """Difference of poses `… x p`; of orientations the rotation vector between them, about the axes of the base."""
    if not machine.orientation:
        return there - here
    turned = rotation_vector_to_matrix(there[..., 3:]) @ rotation_vector_to_matrix(here[..., 3:]).mT
    return torch.cat([there[..., :3] - here[..., :3], matrix_to_rotation_vector(turned)], dim=-1)


def displaced(machine: BlindMachine, pose: Tensor, step: Tensor) -> Tensor:
    """Poses `… x p` moved by small steps; a rotation vector is turned about the axes of the base."""
    if not machine.orientation:
        return pose + step
    rotation = rotation_vector_to_matrix(step[..., 3:]) @ rotation_vector_to_matrix(pose[..., 3:])
    return torch.cat([pose[..., :3] + step[..., :3], matrix_to_rotation_vector(rotation)], dim=-1)
