"""A machine that sags under its own weight, more in one place of its workspace than in another."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects._columns import by_joint
from ccnn_torch.effects._protocol import Coefficient, Kind, Shape
from ccnn_torch.effects._situation import PLATFORM_WEIGHT, Situation
from ccnn_torch.effects.compliance import SCALE
from ccnn_torch.least_squares import jacobian_of
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.rotations import rotation_vector_to_matrix

__all__ = ["Gravity"]

_SECONDARY = 0.3


class Gravity:
    """Δq_i = c_i τ_i, τ = what the machine's own weight asks of the joint per newton, by virtual work.

    For an arm the newton is spread evenly over the origins of its links and the tool; for other machines it hangs on
    the platform. c is compliance times weight: a sag for each metre of lever (turning joints), or along a joint that
    carries all (sliding ones). Secondary is what another mass distribution does: for an arm a weight at the tool, for a
    turning drive of another machine its crank, whose weight asks in proportion to cos q and sin q.
    """

    name = "gravity"
    kind: Kind = "joints"
    description = "a machine that sags under its own weight"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Sag of each joint, then what a further mass adds, joint by joint."""
        found = []
        for joint in situation.mechanism.joints:
            size = SCALE[joint.unit] * PLATFORM_WEIGHT
            unit = "rad/m" if joint.unit == "rad" else "m"
            found.append(Coefficient(joint.name, unit, size, joint=joint.name, positive=True))
            for further in _further(situation.mechanism, joint.unit):
                # A crank of 0.3 m is the lever of its own weight.
                apart, lever = (joint.unit, 0.3) if further != "tool" and joint.unit == "rad" else (unit, 1.0)
                found.append(
                    Coefficient(
                        f"{joint.name} {further}", apart, size * _SECONDARY * lever, joint=joint.name, secondary=True
                    )
                )
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x m`."""
        if isinstance(situation.mechanism, SerialArm):
            return by_joint(torch.stack([_spread_weight(situation), situation.weight_torque], -1))
        columns = by_joint(
            torch.stack([situation.weight_torque, torch.cos(situation.joints), torch.sin(situation.joints)], -1)
        )
        kept = [
            3 * i + k
            for i, j in enumerate(situation.mechanism.joints)
            for k in ((0, 1, 2) if j.unit == "rad" else (0,))
        ]
        return columns[..., kept]


def _further(mechanism: Mechanism, unit: str) -> tuple[str, ...]:
    if isinstance(mechanism, SerialArm):
        return ("tool",)
    return ("crank cos", "crank sin") if unit == "rad" else ()


def _spread_weight(situation: Situation) -> Tensor:
    """What 1 N over the links' origins and the tool asks of each joint of an arm, `... x s x n` [N or N·m per N]."""
    arm = situation.mechanism
    assert isinstance(arm, SerialArm)
    values = arm.resolve(situation.parameters)
    down = (rotation_vector_to_matrix(values[..., 3:6]).mT @ situation.down.unsqueeze(-1)).squeeze(-1)

    def along(joints: Tensor) -> Tensor:
        frames = arm.link_frames(joints, values)
        rotation, flange = frames[-1]
        tool = flange + (rotation @ values[..., -6:-3, None]).squeeze(-1)
        places = torch.stack([*(place for _, place in frames[1:]), tool], -2)
        return (places @ down.unsqueeze(-1)).squeeze(-1).mean(-1, keepdim=True)

    return jacobian_of(along, situation.joints)[1].squeeze(-2).detach()
