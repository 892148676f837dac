"""An effect of your own in one file: a hose package that pulls on the platform like a spring from a hook above it."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects import Coefficient, Kind, Shape, Situation
from ccnn_torch.mechanisms import Mechanism


class HosePull:
    """Δq_i = c_i τ_i, τ = torque on the joint of a pull towards the hook of 1 N for each metre of hose."""

    name = "hose_pull"
    kind: Kind = "joints"  # what it changes: joints, parameters, or the measured pose
    description = "a hose package that pulls the platform towards its hook"
    ordered = False  # rows are independent

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A column that is needed and missing, in words; here none is."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """The coefficients: name, SI unit, plausible size."""
        sizes = {"m": 1e-4, "rad": 1e-4}
        units = {"m": "m/N", "rad": "rad/N/m"}
        joints = situation.mechanism.joints
        return tuple(Coefficient(j.name, units[j.unit], sizes[j.unit], joint=j.name, positive=True) for j in joints)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The shape, with its grid: the height of the hook."""
        return (Shape("height", "m", (0.5, 1.0, 1.5, 2.0, 3.0)),)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """Change of each joint by each coefficient, `... x s x n x n`."""
        up = -situation.down * shape.unsqueeze(-2)
        pull = up - situation.platform[0]
        torque = (situation.jacobian[..., :3, :].mT @ pull.unsqueeze(-1)).squeeze(-1)
        return torch.diag_embed(torch.nan_to_num(torque))
