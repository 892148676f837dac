"""Causes that the effects library lacks, each with what drives it: the right answer to them is "outside"."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ccnn_validation.blind.conditions import Conditions
from ccnn_validation.blind.deviation import Deviation
from ccnn_validation.blind.joint_causes import of_joints
from ccnn_validation.blind.machines import BlindMachine

__all__ = ["OUTSIDE_CAUSES", "outside_cause"]

Generator = np.random.Generator
OUTSIDE_CAUSES = ("workspace", "joint", "load", "temperature", "direction", "time")
"""By the kind of their driver."""


def outside_cause(
    kind: str, machine: BlindMachine, at: Conditions, generator: Generator
) -> tuple[Deviation, tuple[str, ...]]:
    """One of `OUTSIDE_CAUSES` at about unit size, and the drivers that are right, as a verdict names them."""
    return _MAKERS[kind](machine, at, generator)


def _dent(machine: BlindMachine, at: Conditions, generator: Generator) -> tuple[Deviation, tuple[str, ...]]:
    """A joint whose track has a dent in one place."""
    i = int(generator.integers(at.joints.shape[-1]))
    low, high = machine.travel[i].tolist()
    middle = low + (high - low) * generator.uniform(0.3, 0.7)
    width = (high - low) * generator.uniform(0.06, 0.15)
    change = torch.zeros_like(at.joints)
    # One flank is steeper than the other.
    away = (at.joints[:, i] - middle) / width
    away = torch.where(away > 0, away * generator.uniform(0.6, 1.6), away)
    change[:, i] = _bump(away.abs(), generator)
    change[:, i] -= change[:, i].mean()
    return of_joints(machine, change), (f"joint q{i + 1}",)


def _bump(distance: Tensor, generator: Generator) -> Tensor:
    """1 at distance 0 and nearly 0 from 2 on, pointed or flat."""
    return torch.exp(-(distance ** generator.choice([1.3, 2.0, 4.0])))


def _bulge(machine: BlindMachine, at: Conditions, generator: Generator) -> tuple[Deviation, tuple[str, ...]]:
    """A table or a magnet that pulls the platform aside in one corner of the workspace."""
    low, high = machine.mechanism.bounds
    if machine.own_weight is not None:
        low, high = at.pose.amin(0), at.pose.amax(0)
    place = (at.pose - low) / (high - low)
    lengths = torch.tensor([c.unit == "m" for c in machine.mechanism.pose])
    middle = torch.as_tensor(generator.uniform(0.25, 0.75, place.shape[-1]))
    # Longer one way than the other.
    long = torch.as_tensor(generator.uniform(0.7, 1.4, place.shape[-1]))
    square = (((place - middle) * long)[:, lengths] ** 2).sum(-1) / generator.uniform(0.2, 0.3) ** 2
    size = torch.as_tensor(generator.uniform(0.5, 1.5, at.joints.shape[-1]))
    change = size * _bump(square.sqrt(), generator)[:, None]
    change = change - change.mean(0)
    # Where a machine has one length alone, what changes along it changes along all joints alike.
    return of_joints(machine, change * torch.as_tensor(generator.choice([-1.0, 1.0], change.shape[-1]))), ("workspace",)


def _clamp(machine: BlindMachine, at: Conditions, generator: Generator) -> tuple[Deviation, tuple[str, ...]]:
    """A fixture that slips to the same side when it is pulled hard either way."""
    loaded = torch.nonzero(machine.load)[:, 0].numpy()
    i = int(generator.choice(loaded))
    force = at.load[:, i] / machine.load[i]
    slip = torch.nn.functional.softplus(8 * (force.abs() - generator.uniform(0.2, 0.6))) / 8
    name = machine.mechanism.pose[i].name
    return _moved(machine, at, slip, generator), (f"load {name}",)


def _snap(machine: BlindMachine, at: Conditions, generator: Generator) -> tuple[Deviation, tuple[str, ...]]:
    """A bimetal that snaps at one temperature."""
    temperature = at.temperature.numpy()
    turning = np.quantile(temperature, generator.uniform(0.35, 0.65))
    width = np.std(temperature) * generator.uniform(0.05, 0.2)
    return _moved(machine, at, torch.as_tensor(np.tanh((temperature - turning) / width)), generator), ("temperature",)


def _twitch(machine: BlindMachine, at: Conditions, generator: Generator) -> tuple[Deviation, tuple[str, ...]]:
    """The approach of one joint that leaves another one displaced, the more the further out that one is."""
    i, j = generator.permutation(at.joints.shape[-1])[:2]
    low, high = machine.travel[j].tolist()
    change = torch.zeros_like(at.joints)
    place = (2 * at.joints[:, j] - low - high) / (high - low)
    change[:, j] = at.direction[:, i] * (1 + generator.uniform(0.0, 0.7) * place)
    return of_joints(machine, change), (f"direction {i + 1}",)


def _hum(machine: BlindMachine, at: Conditions, generator: Generator) -> tuple[Deviation, tuple[str, ...]]:
    """A pump or a tide that sways the machine with a period of its own, of at least four rows."""
    most = min(len(at.time) / 4, 40.0)
    period = float(at.time[-1]) / np.exp(generator.uniform(np.log(2.5), np.log(most)))
    wave = torch.sin(2 * torch.pi * at.time / period + generator.uniform(0, 2 * np.pi))
    return _moved(machine, at, wave, generator), ("time",)


def _moved(machine: BlindMachine, at: Conditions, course: Tensor, generator: Generator) -> Deviation:
    """The whole platform moved along one way by a course over the rows, `s`: equally at every pose.

    Without what is the same in all rows: that would be a device or a target elsewhere, which a library knows.
    """
    way = torch.as_tensor(generator.normal(size=6))
    way = torch.cat([1e-3 * way[:3], (2e-3 if machine.orientation else 0.0) * way[3:]])
    none = Deviation.none(machine, len(course))
    lengths = {c.name for c in machine.mechanism.pose if c.unit == "m"}
    seen = torch.tensor([name in lengths for name in "xyz"] + [True] * 3, dtype=torch.float64)
    return replace(none, platform=(course - course.mean())[:, None] * way * seen)


_MAKERS = {
    "workspace": _bulge,
    "joint": _dent,
    "load": _clamp,
    "temperature": _snap,
    "direction": _twitch,
    "time": _hum,
}
