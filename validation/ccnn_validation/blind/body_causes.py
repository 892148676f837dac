"""Causes that act on the machine's geometry or on what measures it, by formulas of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import plausible_error
from ccnn_validation.blind.conditions import REFERENCE, Conditions, lagged
from ccnn_validation.blind.deviation import Deviation
from ccnn_validation.blind.machines import BlindMachine

__all__ = ["BODY_CAUSES"]

Generator = np.random.Generator
_DRIVES = {
    "five_bar": ("k", "gamma"),
    "tripod": ("d",),
    "machine_tool": ("u_0",),
    "stewart": ("offset", "gain"),
    "delta": ("offset",),
    "delta_linear": ("offset",),
    "arm": ("base_", "tool_", "theta"),
}
"""Prefixes of parameters of the drives and of the base frame: their errors are other causes."""
_EXPANSION = 1.2e-5


def geometry(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Errors of manufacture and assembly: in all dimensions, or in those of one leg."""
    parts = machine.mechanism.geometry
    of_body = np.array([not p.name.startswith(_DRIVES[machine.mechanism.name]) for p in parts])
    size = np.array([plausible_error(p) for p in parts]) * of_body * generator.standard_normal(len(parts))
    legs = sorted({p.leg for p in parts if p.leg is not None})
    if legs and generator.random() < 0.4:
        chosen = generator.choice(legs)
        size *= np.array([p.leg == chosen for p in parts])
    return replace(_none(machine, at), parameters=torch.as_tensor(size).expand(len(at.time), -1))


def thermal(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """Bodies that warm up in two stages, skin and core, each leg by a slightly different factor."""
    skin, core = generator.uniform(0.05, 0.4) * 3600, generator.uniform(0.6, 2.0) * 3600
    share = generator.uniform(0.3, 0.9)
    body = share * lagged(at.hall, skin) + (1 - share) * lagged(at.hall, core)
    warm = at.at_rows(body) - REFERENCE
    parts = machine.mechanism.geometry
    legs = {leg: generator.uniform(0.7, 1.3) for leg in {p.leg for p in parts}}
    lengths = [
        p.nominal * legs[p.leg] if p.unit == "m" and not p.name.startswith(("base_", "tool_")) else 0.0 for p in parts
    ]
    grown = _EXPANSION * warm[:, None] * torch.tensor(lengths, dtype=torch.float64)
    return replace(_none(machine, at), parameters=grown)


def frame(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """A constant error of the pose of the measuring device."""
    return replace(_none(machine, at), base=_twist(generator))


def tool(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """A constant error of the pose of the target."""
    return replace(_none(machine, at), tool=_twist(generator))


def instrument(machine: BlindMachine, at: Conditions, generator: Generator) -> Deviation:
    """A device whose axes have unequal scales and are not quite square."""
    scale = np.diag(generator.normal(size=3))
    shear = np.triu(generator.normal(size=(3, 3)), 1) * generator.uniform(0.0, 0.7)
    return replace(_none(machine, at), stretch=torch.as_tensor(1e-3 * (scale + shear)))


def _none(machine: BlindMachine, at: Conditions) -> Deviation:
    return Deviation.none(machine, len(at.time))


def _twist(generator: Generator) -> Tensor:
    shift, turn = 1e-3 * generator.normal(size=3), 2e-3 * generator.normal(size=3)
    return torch.as_tensor(np.concatenate([shift, turn * generator.choice([0.2, 1.0])]))


BODY_CAUSES = {
    "geometry": geometry,
    "thermal": thermal,
    "frame": frame,
    "tool": tool,
    "instrument": instrument,
}
