"""Friction that winds up the drives: opposite to the last motion, growing with the load of the joint."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.backlash import Backlash
from ccnn_torch.effects.columns import by_joint, of_rows, one_by_one, per_force
from ccnn_torch.effects.compliance import SCALE
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import PLATFORM_WEIGHT, WEIGHTS, Situation
from ccnn_torch.mechanisms import Mechanism

# A joint's friction is some tenths of what it carries, its constant part like that of a tenth of the platform's weight.
_SHARE = 0.3
# Small: the part that does not depend on the load is backlash, and is called so unless the rest of friction is there.
_CONSTANT = {"m": 6e-6, "rad": 1e-5}


class Friction:
    """Δq_i = -s_i (c_i |τ_load,i| + d_i |τ_weight,i| + e_i): s the direction of approach, τ what the joint carries.

    Coulomb's friction is in proportion to what presses the surfaces together; a drive of compliance C and friction
    coefficient μ stops C μ |τ| short. The weight is that of a platform of 100 N: of another one d is as much larger.
    Secondary: load and weight together, |τ_load + τ_weight|, where they pull apart, the weight a shape; and the part e
    that does not depend on them, which alone is what backlash does.
    """

    name = "friction"
    kind: Kind = "joints"
    description = "friction that winds up the drives against their last motion, growing with their load"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """The direction of approach of at least one joint."""
        return Backlash().missing(mechanism, covariates)

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """By load (where one was recorded), by weight, constant: for each joint whose direction is known."""
        found = []
        for joint in (situation.mechanism.joints[i] for i in situation.directed):
            size = SCALE[joint.unit] * _SHARE
            for part in ("load", "weight") if situation.loaded else ("weight",):
                found.append(
                    Coefficient(f"{joint.name} {part}", per_force(joint.unit), size, joint=joint.name, positive=True)
                )
            if situation.loaded:
                unit = per_force(joint.unit)
                found.append(Coefficient(f"{joint.name} together", unit, size, joint=joint.name, secondary=True))
            constant = _CONSTANT[joint.unit]
            found.append(
                Coefficient(
                    f"{joint.name} constant", joint.unit, constant, joint=joint.name, secondary=True, borrowed=True
                )
            )
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The machine's weight beside a load that was recorded."""
        if not situation.loaded:
            return ()
        together = tuple(k for k, c in enumerate(self.coefficients(situation)) if c.name.endswith("together"))
        return (Shape("weight", "N", WEIGHTS, together, usual=PLATFORM_WEIGHT),)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x m`, joint by joint."""
        return by_joint(self._moves(situation, shape), situation.directed)

    def one_by_one(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same in some of the rows, without its zeros: what each coefficient does to the joint that it moves.

        rows: which, `t`; None = all. Returns `... x t x m`.
        """
        return one_by_one(of_rows(self._moves(situation, shape), rows, -3), situation.directed)

    def _moves(self, situation: Situation, shape: Tensor) -> Tensor:
        load, weight = situation.load_torque, situation.own_weight_torque
        carried = [(weight * PLATFORM_WEIGHT).abs(), torch.ones_like(weight)]
        if situation.loaded:
            carried[:1] = [load.abs(), carried[0], (load + weight * shape[..., 0, None, None]).abs()]
        columns = torch.stack(torch.broadcast_tensors(*carried), -1)  # type: ignore[no-untyped-call]
        return -situation.direction.unsqueeze(-1) * columns
