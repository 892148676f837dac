"""The frame of the measuring device differs from that of the model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import TWIST, shown_columns, twist_columns
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

_SCALE = {"m": 1e-3, "rad": 1e-3}


class Frame:
    """Δposition = t + ω x (position - middle of the workspace), Δrotation = ω, in the base frame."""

    name = "frame"
    kind: Kind = "pose"
    description = "the measuring device's frame: a shift and a turn of the whole machine against it"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A base frame that is known; an unknown one is fitted before anything else."""
        unknown = "base" in getattr(mechanism, "unknown_frames", ())
        return f"a known base frame: that of {mechanism.name} is fitted to the records anyhow" if unknown else ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """As many of shift and turn as the pose shows."""
        return tuple(Coefficient(*TWIST[k], _SCALE[TWIST[k][1]]) for k in shown_columns(situation, _all))

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return _all(situation)[..., shown_columns(situation, _all)]


def _all(situation: Situation) -> Tensor:
    position = situation.platform[0]
    middle = situation.mechanism.frame(situation.mechanism.home_pose)[0]
    axes = torch.eye(3, dtype=position.dtype).expand(*position.shape, 3)
    return twist_columns(situation, position - middle, axes)
