"""Linearisation about the machine with a set of effects; at a large gap the nominal machine is not enough."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import scales
from ccnn_torch.effects import Acting, Effect, Situation, filled, measured_channels, moved, reached, signature
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix


def remainder(
    situation: Situation, measured: Tensor, acting: Sequence[Acting], parameters: Tensor | None = None
) -> Tensor:
    """Measured less reached with the effects, `s x c` [m, rad]; NaN where the machine with them cannot be.

    What was not measured (NaN) is 0. parameters: of the machine that moves; those of the situation when None.
    """
    there, seen = reached(situation, acting, parameters), measured_channels(situation, measured)
    position, rotation = situation.mechanism.frame(filled(situation, measured))
    left = position - there[..., : position.shape[-1]]
    if rotation is not None:
        turn = matrix_to_rotation_vector(rotation @ rotation_vector_to_matrix(there[..., -3:]).mT)
        left = torch.cat([left, turn], -1)
    return left if seen is None else torch.where(seen, left, 0.0 * there)


def signature_at(situation: Situation, there: Situation, effect: Effect, shape: Tensor) -> Tensor:
    """Change of the pose per plausible size of each coefficient about the machine `there`, `s x c x m`."""
    return signature(situation, effect, shape, there) * scales(effect.coefficients(situation), situation.joints)


def tangent(situation: Situation, left: Tensor, acting: Sequence[Acting]) -> tuple[Situation, Tensor]:
    """Where the effects bring the machine, and the residual that a linear model about there has to explain, `s x c`.

    left: the effects' `remainder`; rows that the machine with the effects cannot reach are NaN.
    """
    there = moved(situation, acting)
    for one in acting:
        size = scales(one.effect.coefficients(situation), situation.joints)
        columns = signature_at(situation, there, one.effect, one.shape)
        left = left + (columns @ (one.coefficients / size)[..., None])[..., 0]
    return there, left
