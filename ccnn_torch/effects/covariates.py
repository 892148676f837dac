"""Plausible covariates of rows: times, temperatures, loads, directions of approach."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor

from ccnn_torch.coordinates import force_of, is_temperature, torque_of
from ccnn_torch.effects.columns import inside
from ccnn_torch.effects.situation import PLATFORM_WEIGHT, REFERENCE, Situation, load_columns
from ccnn_torch.effects.time import ROW
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms.gears import turns_of

SHIFT = 8 * 3600.0
"""Rows are spread evenly over a shift [s]."""
# Standard deviations of the load along a coordinate [N], [N·m].
_LOAD = {"m": 60.0, "rad": 6.0}


def draw_covariates(
    mechanism: Mechanism,
    joints: Tensor,
    generator: torch.Generator,
    duration: float = SHIFT,
    load: Mapping[str, float] | None = None,
) -> dict[str, Tensor]:
    """Conditions of rows that were measured one after the other, each at rest.

    The hall drifts by some kelvin over a shift and swings about that; loads are drawn anew for each row; a joint's
    direction is the sign of its way from the row before.

    Args:
        mechanism: whose pose coordinates loads act along.
        joints: commanded, in the order measured, `s x n` [SI].
        generator: of the random numbers.
        duration: from the first row to the last [s].
        load: standard deviation of the load by unit of the pose coordinate [N], [N·m]; None = 60 N and 6 N·m.

    Returns:
        `time`, `temperature`, `load_NAME`, `direction1`…, and what a simulator takes besides, each `s` [SI].
    """
    rows, n = joints.shape

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    time = torch.linspace(0.0, duration, rows, dtype=torch.float64)
    shift = time / SHIFT
    drift = uniform(3.0, 8.0) * (1.0 if uniform(-1, 1) > 0 else -1.0)
    swing, swings, phase = uniform(1.0, 3.0), uniform(2.0, 5.0), uniform(0.0, 2 * math.pi)
    hall = uniform(-2.0, 2.0) + drift * shift + swing * torch.sin(2 * math.pi * swings * shift + phase)
    found = {"time": time, "temperature": REFERENCE + hall}
    sizes = {**_LOAD, **(load or {})}
    for coordinate in inside(mechanism).pose:
        draw = torch.randn(rows, generator=generator, dtype=torch.float64)
        found[f"load_{coordinate.name}"] = sizes[coordinate.unit] * draw
    before = torch.where(torch.rand(1, n, generator=generator, dtype=torch.float64) < 0.5, -1.0, 1.0)
    found |= directions(mechanism, joints, before)
    for condition in mechanism.takes:
        if condition.name not in found and condition.spread > 0:
            draw = torch.randn(rows, generator=generator, dtype=torch.float64)
            found[condition.name] = condition.usual + condition.spread * draw
    return found


def directions(mechanism: Mechanism, joints: Tensor, before: Tensor) -> dict[str, Tensor]:
    """`direction1`…, `s` each: signs of the motors' ways between rows of joints `s x n`, and `before` of the first,
    `1 x n`."""
    way = torch.where(turns_of(mechanism.motors, joints).diff(dim=0) < 0, -1.0, 1.0)
    signs = torch.cat([before, way])[: len(joints)]
    return {f"direction{i + 1}": sign for i, sign in enumerate(signs.unbind(-1))}


def rest_torques(situation: Situation) -> dict[str, Tensor]:
    """`torque_NAME` of each joint, `... x s` [N or N·m]: what 100 N of own weight and the load put on it at rest."""
    torques = PLATFORM_WEIGHT * situation.own_weight_torque + situation.load_torque
    return {torque_of(j): torques[..., i] for i, j in enumerate(situation.mechanism.joints)}


def torques_elsewhere(rows: Situation, there: Situation) -> dict[str, Tensor]:
    """The torques at rest that other rows of a machine have, `t` each, by name, as far as columns of rows `s` tell.

    Each joint's by least squares: a constant, what its own weight, spread in two ways, and the load put on it.
    """

    def causes(at: Situation) -> Tensor:
        parts = [torch.ones_like(at.joints), at.own_weight_torque, at.weight_torque, at.load_torque]
        return torch.stack(parts, -1).movedim(-2, 0)

    found, known, new = {}, causes(rows), causes(there)
    for joint, here, other in zip(rows.mechanism.joints, known, new, strict=True):
        if (name := torque_of(joint)) in rows.covariates:
            shares = torch.linalg.lstsq(here, rows.covariates[name][:, None], driver="gelsd").solution
            found[name] = (other @ shares)[:, 0]
    return found


def covariate_units(mechanism: Mechanism, names: Iterable[str] = ()) -> dict[str, str]:
    """SI unit of every column that the library's effects know, or the machine itself takes, by name.

    names: of columns that are there; a machine may have any number of thermometers.
    """
    units = {c.name: c.unit for c in mechanism.takes} | {"time": "s", ROW: "1", "temperature": "K"}
    units |= {name: "K" for name in names if is_temperature(name)}
    units |= load_columns(mechanism)
    units |= {torque_of(j): force_of(j.unit) for j in mechanism.joints}
    units |= {f"direction{i + 1}": "1" for i in range(len(mechanism.joints))}
    return units | {f"speed{i + 1}": f"{j.unit}/s" for i, j in enumerate(mechanism.joints)}
