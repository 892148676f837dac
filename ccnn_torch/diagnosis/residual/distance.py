"""Distance of measured poses from nominal ones, relative to the size of the machine."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.effects import Situation, pose_residual

USUAL = 0.3
"""Sizes of the machine: where the usual row is so far off, no small deviation is to be searched in any of them."""
# What a machine that does not move or turn is taken to [m], [rad].
_LEAST = 1e-6


class Size(NamedTuple):
    """Spread of a machine's poses over its workspace.

    Attributes:
        place: RMS distance from their mean [m].
        angle: RMS angle to their mean [rad], or None without orientation.
    """

    place: Tensor
    angle: Tensor | None


def size_of(situation: Situation) -> Size:
    """How large the machine is."""
    place, rotation = situation.samples.platform
    spread = (place - place.mean(0)).square().sum(-1).mean().sqrt()
    # The mean of rotation matrices falls short of one by twice the square of the angle that they are spread by.
    angle = None if rotation is None else ((3 - rotation.mean(0).square().sum()).clamp_min(0) / 2).sqrt()
    return Size(spread, angle)


def distance(situation: Situation, measured: Tensor, size: Size) -> Tensor:
    """Distance of each pose from the nominal one, in sizes of the machine, `s` [1].

    The larger of position and rotation; NaN where the machine has no pose.

    Args:
        situation: `s` rows.
        measured: poses, `s x p` [SI].
        size: of the machine.
    """
    residual = pose_residual(situation, measured)
    turns = torch.tensor([c.unit == "rad" for c in situation.mechanism.channels])
    far: Tensor = torch.linalg.vector_norm(residual[:, ~turns], dim=-1) / size.place.clamp_min(_LEAST)
    if bool(turns.any()) and size.angle is not None:
        far = torch.maximum(far, torch.linalg.vector_norm(residual[:, turns], dim=-1) / size.angle.clamp_min(_LEAST))
    return far
