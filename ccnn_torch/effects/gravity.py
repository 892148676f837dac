"""Deflection under the machine's own weight."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import by_joint
from ccnn_torch.effects.compliance import SCALE
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import PLATFORM_WEIGHT, Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm

_SECONDARY = 0.3
# What an arm may carry elsewhere than evenly: no correction of a form.
_MASSES = ("tool", "inner links")
# Lever by which a turning joint carries weight, by and large [m]; a sliding one carries a share of it [1].
_LEVER = 0.3
# Weight times the way from the measured point to the centre of mass [N·m].
_MOMENT = 5.0


class Gravity:
    """Δq_i = c_i τ_i, τ = force or torque of the machine's own weight on the joint per newton, by virtual work.

    For an arm the newton is spread evenly over the origins of its links and the tool; for other machines it hangs on
    the measured point of the platform. c is compliance times weight: a sag for each metre of lever (turning joints), or
    along a joint that carries all (sliding ones). Secondary: a joint that stiffens, d τ|τ| / 0.3 m (or / 1); what
    another mass distribution does: for an arm a weight at the tool, and one that is larger towards the base; for a
    turning drive of another machine its crank, whose weight acts in proportion to cos q and sin q, and for a platform
    that turns the moment of its weight about the measured point, in its own axes, on drives of plausible compliance.
    """

    name = "gravity"
    kind: Kind = "joints"
    description = "deflection under the machine's own weight"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Sag of each joint and what goes with it, joint by joint; then the centre of mass."""
        mechanism, found = situation.mechanism, []
        for joint in mechanism.joints:
            turning = joint.unit == "rad"
            unit, size = "rad/m" if turning else "m", SCALE[joint.unit] * PLATFORM_WEIGHT
            found.append(Coefficient(joint.name, unit, size, joint=joint.name, positive=True))
            parts = [("stiffening", unit, size)]
            if isinstance(mechanism, SerialArm):
                parts += [("tool", unit, size), ("inner links", unit, size)]
            elif turning:
                parts += [(f"crank {wave}", "rad", size * _LEVER) for wave in ("cos", "sin")]
            # No input link weighs many times as much as the platform; a tool may.
            found += [
                Coefficient(
                    f"{joint.name} {part}",
                    u,
                    _SECONDARY * v,
                    joint=joint.name,
                    secondary=True,
                    mends=part not in _MASSES,
                )
                for part, u, v in parts
            ]
        if _centred(situation):
            found += [Coefficient(f"centre {axis}", "N*m", _MOMENT, secondary=True) for axis in "xyz"]
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x m`."""
        mechanism, joints = situation.mechanism, situation.joints
        turning = [j.unit == "rad" for j in mechanism.joints]
        lever = torch.tensor([_LEVER if turns else 1.0 for turns in turning], dtype=joints.dtype)
        arm = isinstance(mechanism, SerialArm)
        weight = situation.own_weight_torque
        parts = [weight, weight * weight.abs() / lever]
        if arm:
            parts += [situation.weight_torque, situation.inner_weight_torque]
        else:
            parts += [torch.cos(joints), torch.sin(joints)]
        columns = by_joint(torch.stack(parts, -1))
        if not arm:
            kept = [4 * i + k for i, turns in enumerate(turning) for k in (range(4) if turns else range(2))]
            columns = columns[..., kept]
        return torch.cat([columns, _off_centre(situation)], -1) if _centred(situation) else columns


def _centred(situation: Situation) -> bool:
    """Whether the platform's centre of mass has columns: it turns, and is no arm's, whose tool is small."""
    return not isinstance(situation.mechanism, SerialArm) and situation.platform[1] is not None


def _off_centre(situation: Situation) -> Tensor:
    """Change of the joints by a moment of 1 N·m of the weight along each axis of the platform, `... x s x n x 3`."""
    rotation = situation.platform[1]
    assert rotation is not None
    moment = torch.linalg.cross(rotation.mT, situation.down.expand_as(rotation), dim=-1)
    scale = torch.tensor([SCALE[j.unit] for j in situation.mechanism.joints], dtype=rotation.dtype)
    jacobian = torch.nan_to_num(situation.jacobian)
    torques: Tensor = jacobian[..., 3:, :].mT @ moment.mT
    return scale[:, None] * torques
