"""An effect that is set anew in each group of rows, such as the nights of a telescope."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects.protocol import Coefficient, Effect
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

BY = " by "
"""Between the name of an effect and what its groups are called."""


class ByGroup(Effect):
    """Another effect with coefficients of its own in each group of rows; a group's rows share the base frame."""

    def __init__(self, effect: Effect, word: str, frames: Mapping[str, Tensor]) -> None:
        """Take the effect, what a group is called, and the base frame of each group by name, `6` [m, rad]."""
        self.effect, self.kind, self.frames = effect, effect.kind, dict(frames)
        self.name = f"{effect.name}{BY}{word}"
        self.description = f"{effect.description}: another one in each {word}"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """As the effect."""
        return self.effect.missing(mechanism, covariates)

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Those of the effect, group by group."""
        own = self.effect.coefficients(situation)
        return tuple(replace(c, name=f"{group}: {c.name}", joint=None, leg=None) for group in self.frames for c in own)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x d x (groups · m)`."""
        values = situation.mechanism.resolve(situation.parameters)[..., :6]
        inside = [(values == frame).all(-1, keepdim=True) for frame in self.frames.values()]
        own = self.effect.basis(situation, shape)
        return torch.cat([own * mine.expand(*own.shape[:-2], 1)[..., None] for mine in inside], -1)
