"""Joints that give under an external load, and stiffen."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects._protocol import Coefficient, Kind, Shape
from ccnn_torch.effects._situation import Situation
from ccnn_torch.mechanisms import Mechanism

__all__ = ["Compliance"]

# Plausible compliance of a drive: 1e-7 m/N (10 N/µm), 2e-6 rad/(N·m).
_SCALE = {"m": 1e-7, "rad": 2e-6}


class Compliance:
    """Δq_i = c_i τ_i + d_i τ_i |τ_i| / τ_rms, τ = what the external load asks of the joint."""

    name = "compliance"
    kind: Kind = "joints"
    description = "joints that give under an external load (and stiffen or soften with it)"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A load that was measured."""
        there = any(f"load_{c.name}" in covariates for c in mechanism.pose)
        along = " or ".join(f"load_{c.name}[{'N' if c.unit == 'm' else 'N*m'}]" for c in mechanism.pose)
        return "" if there else f"a column of the load on the platform: {along}"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint, then one a joint for what is not proportional."""
        return tuple(
            Coefficient(
                f"{j.name}{' stiffening' if secondary else ''}",
                f"{j.unit}/{'N' if j.unit == 'm' else '(N*m)'}",
                _SCALE[j.unit] * (0.3 if secondary else 1.0),
                joint=j.name,
                secondary=secondary,
            )
            for secondary in (False, True)
            for j in situation.mechanism.joints
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 2n`."""
        torque = situation.load_torque
        rms = torque.square().mean(-2, keepdim=True).sqrt().clamp_min(1e-300)
        return torch.cat([torch.diag_embed(torque), torch.diag_embed(torque * torque.abs() / rms)], -1)
