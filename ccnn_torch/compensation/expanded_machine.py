"""A machine without closed forms: where it is, and what was identified moves, as polynomials of the joints."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ccnn_torch.compensation.effects import PhysicalEffects
from ccnn_torch.compensation.expansions import ChebyshevExpansion, expand
from ccnn_torch.compensation.kinematics import Placed
from ccnn_torch.compensation.machine import RULE, Machine, Rule
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

# Errors of the polynomials, as shares of the largest value. The slope of the place makes a correction of what moves it,
# which is known to some per cent; the rates only say how fast a command settles.
_PLACE, _RATES = 1e-3, 0.1
# Share of the polynomials' box that is left for corrections at its edge.
_INSIDE = 0.95


class ExpandedMachine(Machine):
    """All polynomials are of the nominal machine's joints, so that errors of `place` cancel in a command.

    Attributes:
        place: position and rotation matrix row by row of the nominal machine, `... x 3` or `... x 12` [m, 1].
        rates: velocity and rate of rotation by each joint, `... x (n c)` [m, rad per joint unit].
        apart: by what the identified machine is elsewhere, position and rotation vector, `... x c` [m, rad].
    """

    kind = "expanded"

    def __init__(
        self,
        identified: Tensor,
        place: ChebyshevExpansion,
        rates: ChebyshevExpansion,
        apart: ChebyshevExpansion,
        effects: PhysicalEffects | None = None,
        rule: Rule = RULE,
    ) -> None:
        endless = torch.full_like(place.centre, torch.inf)
        super().__init__(identified, -endless, endless, effects, rule)
        self.place, self.rates, self.apart = place, rates, apart

    def known(self, joints: Tensor) -> Tensor:
        box = self.place
        half = _INSIDE * box.half_range
        return torch.minimum(torch.maximum(joints, box.centre - half), box.centre + half)

    def nominal_at(self, joints: Tensor) -> Placed:
        place, rates = self.place(joints), self.rates(joints).reshape(*joints.shape, -1)
        turned = place.shape[-1] > 3
        rotation = place[..., 3:].reshape(*joints.shape[:-1], 3, 3) if turned else None
        return Placed(place[..., :3], rotation, rates[..., :3], rates[..., 3:])

    def identified_at(self, joints: Tensor) -> Placed:
        return self.nominal_at(joints).shifted(self.apart(joints))

    def description(self) -> dict[str, Any]:
        parts = (self.place, self.rates, self.apart)
        return {"joints": len(self.low), "degrees": [part.degree for part in parts], "turns": parts[0].outputs > 3}

    @classmethod
    def made(
        cls, description: dict[str, Any], identified: Tensor, effects: PhysicalEffects | None, rule: Rule
    ) -> ExpandedMachine:
        blank = torch.ones(description["joints"], dtype=torch.float64)
        widths = (12, 6 * len(blank), 6) if description["turns"] else (3, 3 * len(blank), 3)
        sizes = zip(description["degrees"], widths, strict=True)
        place, rates, apart = (ChebyshevExpansion(blank.clone(), blank.clone(), *size) for size in sizes)
        return cls(identified, place, rates, apart, effects, rule)


def expand_machine(
    mechanism: Mechanism,
    identified: Tensor,
    effects: PhysicalEffects | None,
    joints: Tensor,
    margin: float,
    rule: Rule = RULE,
) -> ExpandedMachine:
    """The machine over the domain of the training rows; arguments as of `build_machine`.

    Raises:
        InputError, MethodFailedError: as `expand`.
    """

    def place(points: Tensor) -> Tensor:
        position, rotation = mechanism.frame(mechanism.forward_kinematics(points))
        return position if rotation is None else torch.cat([position, rotation.flatten(-2)], -1)

    def rates(points: Tensor) -> Tensor:
        return mechanism.jacobian_at(mechanism.forward_kinematics(points), points).mT.flatten(-2)

    def apart(points: Tensor) -> Tensor:
        pose = mechanism.forward_kinematics(points)
        (before, turned), (after, turning) = map(
            mechanism.frame, (pose, mechanism.forward_kinematics(points, identified, pose))
        )
        if turned is None or turning is None:
            return after - before
        return torch.cat([after - before, matrix_to_rotation_vector(turning @ turned.mT)], -1)

    turns = len(mechanism.channels) == 6
    by_unit = [3, 3] if turns else [3]
    return ExpandedMachine(
        identified,
        expand(place, joints, margin, "pose", [3, 9] if turns else [3], _PLACE),
        expand(rates, joints, margin, "Jacobian", by_unit * joints.shape[-1], _RATES),
        expand(apart, joints, margin, "geometric deviation", by_unit),
        effects,
        rule,
    )
