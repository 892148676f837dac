"""Errors of the measuring device: scale of its axes, and their squareness."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import shown_columns
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

_AXES = "xyz"
_PAIRS = ((0, 1), (0, 2), (1, 2))
_COEFFICIENTS = (
    *(Coefficient(f"scale {a}", "1", 3e-4) for a in _AXES),
    *(Coefficient(f"shear {_AXES[i]}{_AXES[j]}", "rad", 3e-4) for i, j in _PAIRS),
    *(Coefficient(f"lean {_AXES[i]}{_AXES[j]}", "rad", 1e-4, secondary=True) for i, j in _PAIRS),
    *(Coefficient(f"zero {a}", "m", 1e-4, secondary=True) for a in _AXES),
    *(Coefficient(f"scale r{a}", "1", 1e-3, secondary=True) for a in _AXES),
)


class Instrument:
    """Δposition = S (position - middle of the workspace) + z, S symmetric: no rigid motion but by what is secondary.

    The diagonal of S are errors of scale, beside it is half the angle by which two axes are not square. Secondary:
    lean, the other half, a turn, since the device aligns one of the two axes with the machine and not their bisector;
    z, since its own zero is not the middle of the workspace; and a scale of the measured angles where the machine's
    angles are measured as such (not by the frames of an arm).
    """

    name = "instrument"
    kind: Kind = "pose"
    description = "the measuring device itself: errors of scale and axes that are not square"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Scale of each axis and shear of each pair that the pose shows; zeros and angular scales as secondary ones."""
        return tuple(_COEFFICIENTS[k] for k in shown_columns(situation, _all))

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return _all(situation)[..., shown_columns(situation, _all)]


def _all(situation: Situation) -> Tensor:
    """`... x s x c x 15`, columns as in `_COEFFICIENTS`."""
    mechanism = situation.mechanism
    position, rotation = situation.platform
    from_middle = position - mechanism.frame(mechanism.home_pose)[0]
    shear = [torch.zeros_like(from_middle) for _ in _PAIRS]
    for column, (i, j) in zip(shear, _PAIRS, strict=True):
        column[..., i] = from_middle[..., j] / 2
        column[..., j] = from_middle[..., i] / 2
    lean = [column.clone() for column in shear]
    for column, (i, _) in zip(lean, _PAIRS, strict=True):
        column[..., i] = -column[..., i]
    zero = torch.zeros(*position.shape, 3, dtype=position.dtype)
    shift = torch.eye(3, dtype=position.dtype).expand_as(zero)
    linear = torch.cat([torch.diag_embed(from_middle), torch.stack(shear, -1), torch.stack(lean, -1), shift, zero], -1)
    if situation.visible.shape[-1] == 3:
        return situation.visible @ linear
    angles = torch.zeros_like(position)
    if rotation is not None and not mechanism.orientations:
        angles = matrix_to_rotation_vector(rotation)
    turning = torch.cat([zero, zero, zero, zero, torch.diag_embed(angles)], -1)
    return situation.visible @ torch.cat([linear, turning], -2)
