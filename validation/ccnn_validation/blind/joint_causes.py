"""Causes that act on the drives, by formulas of their own: no textbook form, and none of the effects library.

Each function draws one machine's cause at about unit size; a factor is put on later. A joint is counted in units of
half its travel, u = (q - middle) / half, and a force in units of its RMS over the rows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ccnn_validation.blind.conditions import Conditions
from ccnn_validation.blind.deviation import Deviation
from ccnn_validation.blind.machines import BlindMachine

__all__ = ["JOINT_CAUSES", "normalised", "of_joints", "some_of"]

Generator = np.random.Generator
_BALANCED = 0.6
"""Share of machines whose weight does not add to the drives' friction."""


def of_joints(machine: BlindMachine, change: Tensor) -> Deviation:
    """A change of the joints alone, `s x n` in units of half a joint's travel."""
    half = (machine.travel[:, 1] - machine.travel[:, 0]) / 2
    return replace(Deviation.none(machine, len(change)), joints=change * half)


def some_of(count: int, generator: Generator) -> Tensor:
    """Sizes of 0.5 to 1.5 with either sign, on all or on one to three of so many; `count`."""
    size = generator.uniform(0.5, 1.5, count) * generator.choice([-1.0, 1.0], count)
    if generator.random() < 0.5:
        kept = generator.permutation(count)[: int(generator.integers(1, min(3, count) + 1))]
        size[np.setdiff1d(np.arange(count), kept)] = 0.0
    return torch.as_tensor(size)


def normalised(force: Tensor) -> Tensor:
    """Divided by the RMS over the rows and over all drives, `s x n`: a drive without load stays at 0."""
    return force / force.square().mean().sqrt().clamp_min(1e-12)


def _place(machine: BlindMachine, joints: Tensor) -> Tensor:
    """u, -1 to 1 over the travel, `s x n`."""
    low, high = machine.travel.unbind(-1)
    return (2 * joints - low - high) / (high - low)


def joint_offset(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Encoders that were mounted off their zero."""
    return of_joints(machine, some_of(at.joints.shape[-1], generator).expand(at.joints.shape))


def joint_gain(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """An error of the pitch, slightly larger at the ends of the travel."""
    u = _place(machine, at.joints)
    uneven = torch.as_tensor(generator.uniform(-0.02, 0.02, u.shape[-1]))
    return of_joints(machine, some_of(u.shape[-1], generator) * (u + uneven * u**3))


def transmission(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Two harmonics of unequal size and a small fourth: per turn of a gear, or several over a screw's travel."""
    n = at.joints.shape[-1]
    low, high = machine.travel.unbind(-1)
    turns = torch.as_tensor(generator.uniform(2.5, 9.0, n)) * 2 * torch.pi / (high - low)
    teeth = torch.as_tensor(generator.choice([1, 2, 3, 4, 6, 8, 12, 20], n), dtype=torch.float64)
    phase = turns * at.joints if machine.screw else teeth * at.joints
    share = torch.as_tensor(generator.uniform(0.2, 0.9, n))
    start = torch.as_tensor(generator.uniform(0, 2 * np.pi, (3, n)))
    waves = torch.sin(phase + start[0]) + share * torch.sin(2 * phase + start[1])
    return of_joints(machine, some_of(n, generator) * (waves + 0.03 * torch.sin(4 * phase + start[2])))


def backlash(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Backlash: the output trails behind the motion, and leaves that flank where the load pushes the other way."""
    n = at.joints.shape[-1]
    push = normalised(at.torque + at.weight) * generator.uniform(0.0, 0.6) - at.direction * generator.uniform(1.0, 2.0)
    return of_joints(machine, some_of(n, generator).abs() * torch.tanh(push / generator.uniform(0.3, 0.7)))


def friction(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Wind-up behind the motion by a friction that grows with the drive's load, a little less than in proportion.

    Most axes are balanced, so that the load alone acts; in others it adds to the weight.
    """
    balanced = generator.random() < _BALANCED
    carried = normalised(at.torque if balanced else at.torque + at.weight).abs()
    held = generator.uniform(0.1, 0.4) + carried ** generator.uniform(0.9, 1.0)
    return of_joints(machine, -some_of(at.joints.shape[-1], generator).abs() * at.direction * held)


def compliance(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Springs that stiffen: d + k d³ = τ, solved for the deflection by Cardano's formula."""
    force, k = normalised(at.torque), generator.uniform(0.02, 0.4)
    root = torch.sqrt((force / (2 * k)) ** 2 + 1 / (27 * k**3))
    one, other = force / (2 * k) + root, force / (2 * k) - root
    given = torch.sign(one) * one.abs() ** (1 / 3) + torch.sign(other) * other.abs() ** (1 / 3)
    return of_joints(machine, some_of(force.shape[-1], generator).abs() * given)


def gravity(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Drives that sink under the machine's own weight, softer at first (wind-up)."""
    force = normalised(at.weight)
    given = force + generator.uniform(0.0, 0.3) * torch.tanh(2 * force)
    stiff = torch.as_tensor(generator.uniform(0.5, 1.5, force.shape[-1]))
    return of_joints(machine, stiff * given)


def drift(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """References that creep: with the logarithm of time, or towards an end in two stages."""
    hours = at.time[:, None] / 3600
    n = at.joints.shape[-1]
    if generator.random() < 0.5:
        crept = torch.log1p(hours / torch.as_tensor(generator.uniform(0.1, 2.0, 1)))
    else:
        first, second = generator.uniform(0.3, 1.0), generator.uniform(2.0, 5.0)
        crept = 0.6 * (1 - torch.exp(-hours / first)) + 0.8 * (1 - torch.exp(-hours / second))
    return of_joints(machine, some_of(n, generator) * crept)


def coupling(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """One or two drives that are bent by the motion of another one."""
    u = _place(machine, at.joints)
    n, change = u.shape[-1], torch.zeros_like(u)
    for _ in range(int(generator.integers(1, 3))):
        bent, mover = generator.permutation(n)[:2]
        moved = 2 * torch.sin(u[:, mover] / 2) if generator.random() < 0.5 else u[:, mover]
        change[:, bent] += generator.uniform(0.5, 1.5) * generator.choice([-1.0, 1.0]) * moved
    return of_joints(machine, change)


def latency(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """The pose is read late, or early: where the path was that much before, q - v t + a t² / 2."""
    assert at.speed is not None and at.acceleration is not None
    late = generator.uniform(0.005, 0.02)
    past = -at.speed * late + at.acceleration * late**2 / 2
    return replace(Deviation.none(machine, len(past)), joints=past * generator.choice([-1.0, 1.0]))


JOINT_CAUSES = {
    "joint_offset": joint_offset,
    "joint_gain": joint_gain,
    "transmission": transmission,
    "backlash": backlash,
    "friction": friction,
    "compliance": compliance,
    "gravity": gravity,
    "drift": drift,
    "coupling": coupling,
    "latency": latency,
}
