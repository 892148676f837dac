"""Error of the tool frame on the platform."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import TWIST, shown_columns, twist_columns
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm

_SCALE = {"m": 1e-3, "rad": 1e-3}


class Tool:
    """Δposition = R t, Δrotation = R ω: a shift and a turn in the platform's own axes R."""

    name = "tool"
    kind: Kind = "pose"
    description = "the measured point on the platform: a shift and a turn of the tool or target against it"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A platform that turns, and a tool frame that is known; an unknown one is fitted before anything else."""
        if "tool" in getattr(mechanism, "unknown_frames", ()):
            return f"a known tool frame: that of {mechanism.name} is fitted to the records anyhow"
        if not isinstance(mechanism, SerialArm) and mechanism.frame(mechanism.home_pose)[1] is None:
            return "a platform that turns: on this one a shift of the tool is a shift of the frame"
        return ""

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
    position, rotation = situation.platform
    axes = torch.eye(3, dtype=position.dtype).expand(*position.shape, 3) if rotation is None else rotation
    return twist_columns(situation, torch.zeros_like(position), axes)
