"""Deflection of joints, legs and links under an external load."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import per_force
from ccnn_torch.effects.members import arm_axes, members
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm

SCALE = {"m": 1e-7, "rad": 2e-6}
"""Plausible compliance of a drive: 1e-7 m/N (10 N/µm), 2e-6 rad/(N·m)."""
_SECONDARY = 0.3
# How far from the measured point a load may act [m].
_AWAY = 0.1
# What a joint carries, by and large [N], [N·m]: stiffening is given there.
_TYPICAL = {"m": 100.0, "rad": 30.0}


class Compliance:
    """Δq_i = c_i τ_i + d_i τ_i |τ_i| / τ_0 + h_i τ_i³ / τ_0², τ = force or torque of the load on the joint; and
    members that give, e_k.

    τ_0 = 100 N or 30 N·m: d and h are changes of compliance there. Secondary as well, the members: a leg stretches in
    all its lengths p in proportion to the force of the load on them, Δp = e (∂x/∂p) · load (virtual work); a link of an
    arm tilts at its joint under the part of the moment that the joint does not carry. All to first order about the
    nominal pose, so that the effect is one on the pose.
    """

    name = "compliance"
    kind: Kind = "pose"
    description = "deflection of joints, legs and links under an external load (linear and stiffening)"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A load that was measured."""
        there = any(f"load_{c.name}" in covariates for c in mechanism.pose)
        along = " or ".join(f"load_{c.name}[{'N' if c.unit == 'm' else 'N*m'}]" for c in mechanism.pose)
        return "" if there else f"a column of the load on the platform: {along}"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint, then two a joint for what is not proportional, then the members."""
        mechanism = situation.mechanism
        found = [
            Coefficient(
                f"{j.name}{part}",
                per_force(j.unit),
                SCALE[j.unit] * (_SECONDARY if part else 1.0),
                joint=j.name,
                secondary=bool(part),
                positive=not part,
            )
            for part in ("", " stiffening", " hardening")
            for j in mechanism.joints
        ]
        if isinstance(mechanism, SerialArm):
            tilt, away = SCALE["rad"] * _SECONDARY, SCALE["rad"] * _AWAY
            turning = [mechanism.joints[i].name for i in _turning(mechanism)]
            return (
                *found,
                *(Coefficient(f"{j.name} tilt", "rad/N/m", tilt, j.name, None, True) for j in mechanism.joints),
                *(Coefficient(f"{j} load {axis}", "rad/N", away, j, None, True) for j in turning for axis in "xyz"),
            )
        stretch = SCALE["m"] * _SECONDARY
        return (*found, *(Coefficient(m.name, "m/N", stretch, m.joint, m.leg, True) for m in members(mechanism)))

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        jacobian, torque = torch.nan_to_num(situation.jacobian), situation.load_torque
        typical = torch.tensor([_TYPICAL[j.unit] for j in situation.mechanism.joints], dtype=torch.float64)
        ratio = torque.abs() / typical
        parts = [jacobian * (torque * ratio**k).unsqueeze(-2) for k in range(3)]
        arm = isinstance(situation.mechanism, SerialArm)
        return torch.cat([*parts, *_of_an_arm(situation)] if arm else [*parts, _stretching(situation)], -1)


def _stretching(situation: Situation) -> Tensor:
    """Change of the pose by the members of a machine with legs, `... x s x c x (members)`."""
    slope = torch.nan_to_num(situation.parameter_jacobian)
    torques = slope.mT @ situation.wrench.unsqueeze(-1)
    found = members(situation.mechanism)
    moved = [slope[..., m.lengths] @ torques[..., m.lengths, :] for m in found]
    return torch.cat(moved, -1) if found else slope[..., :0]


def _turning(mechanism: Mechanism) -> list[int]:
    return [i for i, j in enumerate(mechanism.joints) if j.unit == "rad"]


def _of_an_arm(situation: Situation) -> list[Tensor]:
    """Change of the pose by links that tilt at their joints, `... x s x c x n`, and by joints that give under the
    moment of a load that acts 1 m away from the measured point along each axis of the tool, `... x s x c x 3t`."""
    arm = situation.mechanism
    assert isinstance(arm, SerialArm)
    points, axes = arm_axes(arm, situation.joints, arm.resolve(situation.parameters))
    place, rotation = situation.platform
    assert rotation is not None
    lever = place.unsqueeze(-2) - points
    wrench = situation.wrench.unsqueeze(-2)
    force = wrench[..., :3]
    moment = torch.linalg.cross(*torch.broadcast_tensors(lever, force), dim=-1)  # type: ignore[no-untyped-call]
    if wrench.shape[-1] == 6:
        moment = moment + wrench[..., 3:]
    across = moment - (moment * axes).sum(-1, keepdim=True) * axes
    shift = torch.linalg.cross(across, lever, dim=-1)
    tilting = (shift if wrench.shape[-1] == 3 else torch.cat([shift, across], -1)).mT
    away = torch.linalg.cross(*torch.broadcast_tensors(rotation.mT, force), dim=-1)  # type: ignore[no-untyped-call]
    turning = _turning(arm)
    torque = (axes @ away.mT)[..., turning, :]
    jacobian = torch.nan_to_num(situation.jacobian)[..., turning]
    return [tilting, (jacobian.unsqueeze(-1) * torque.unsqueeze(-3)).flatten(-2)]
