"""A blind case with everything about it, and the noise of its measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_validation.blind.machines import BlindMachine
from ccnn_validation.blind.plan import CasePlan

__all__ = ["CAUSES_STREAM", "CONDITIONS_STREAM", "NOISE_STREAM", "BlindCase", "displaced", "draw_noise", "gap"]

CONDITIONS_STREAM, CAUSES_STREAM, NOISE_STREAM = 1, 2, 3
"""Streams of random numbers of a case."""
_BAD = (0.02, 0.05)
"""Share of bad rows; each has an error of 20 to 200 times the noise."""


@dataclass(frozen=True)
class BlindCase:
    """A case and its truth; the diagnosis gets `joints`, `measured`, `columns`, and `sd` if the plan discloses it.

    Attributes:
        true: pose without noise, `s x p` [SI].
        sd: standard deviation of the noise of each pose coordinate, `p` [SI].
        drivers: of each cause, as a verdict may name them where it says that no effect fits; () where it has none of
            its own.
        bad: gross outliers, 0-based.
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


def draw_noise(plan: CasePlan, sd: Tensor, generator: np.random.Generator) -> tuple[Tensor, tuple[int, ...]]:
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
