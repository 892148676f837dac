"""A machine whose inverse kinematics is a closed form: the nominal pose, then the identified inverse."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ccnn_torch.compensation.effects.effects import PhysicalEffects
from ccnn_torch.compensation.geometry.chebyshev import ChebyshevExpansion, expand
from ccnn_torch.compensation.geometry.closed_form import ClosedKinematics
from ccnn_torch.compensation.machine.machine import RULE, Machine, Rule
from ccnn_torch.mechanisms import Mechanism, SerialArm

_MOST_NEWTON = 8
# Error of the polynomial from which Newton's method comes to the right pose, as a share of the largest.
_START = 0.1


class InverseMachine(Machine):
    """g(P⁻¹(X, c); θ) - e_joints: every step finds the joints that the identified machine has at the pose.

    Attributes:
        start: polynomial from which Newton's method finds the nominal pose of ideal joints.
        newton: how many steps it takes.
    """

    kind = "inverse"

    def __init__(
        self,
        mechanism: Mechanism,
        identified: Tensor,
        effects: PhysicalEffects | None = None,
        rule: Rule = RULE,
        start: ChebyshevExpansion | None = None,
        newton: int = _MOST_NEWTON,
    ) -> None:
        assert start is not None
        super().__init__(mechanism, identified, effects, rule)
        self.start = start
        # In a tuple, since the polynomial is stored once.
        self._closed = (ClosedKinematics(mechanism, start), ClosedKinematics(self.real, start))
        self.newton = newton

    def aim(self, joints: Tensor) -> Tensor:
        """Pose coordinates `... x p` [SI], and 1 where the machine cannot take the pose."""
        pose, there = self._closed[0].standing(joints, self.newton)
        return self._flat_pose(pose, there, self.identified)

    def aim_back(self, moved: Tensor, covariates: Tensor) -> Tensor:
        joints, shift = (None, None) if self.effects is None else self.effects.changes(moved, covariates)
        pose, there = self._closed[1].standing(moved if joints is None else moved + joints, self.newton)
        pose = pose if shift is None else pose + self._coordinates(pose, shift)
        return self._flat_pose(pose, there, self.mechanism.nominal)

    def next_correction(
        self, moved: Tensor, covariates: Tensor, ideal: Tensor, correction: Tensor, aim: Tensor
    ) -> Tensor:
        joints, shift = (None, None) if self.effects is None else self.effects.changes(moved, covariates)
        pose = aim[..., :-1]
        pose = pose if shift is None else pose - self._coordinates(pose, shift)
        wanted = self.mechanism.solve_inverse(pose, self.identified)
        # Command and what is added to it are the joints of the real machine.
        added = moved - (ideal - correction)
        found = ideal - wanted + (added if joints is None else added + joints)
        return _where_there(found, aim)

    def next_back(self, joints: Tensor, correction: Tensor, aim: Tensor) -> Tensor:
        found = joints + correction - self.mechanism.solve_inverse(aim[..., :-1])
        return _where_there(found, aim)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"degree": self.start.degree, "newton": self.newton}

    @classmethod
    def _blank(cls, mechanism: Mechanism, description: dict[str, Any]) -> dict[str, Any]:
        unit = torch.ones(len(mechanism.joints), dtype=torch.float64)
        polynomial = ChebyshevExpansion(unit, unit.clone(), description["degree"], outputs=len(mechanism.pose))
        return {"start": polynomial, "newton": description["newton"]}

    def _prepare(self) -> None:
        pass

    def _flat_pose(self, pose: Tensor, there: Tensor, values: Tensor) -> Tensor:
        """Pose coordinates, and 0 where they are reached with these parameters, too, else 1."""
        reached = torch.isfinite(self.mechanism.solve_inverse(pose, values)).all(-1, keepdim=True)
        return torch.cat([pose, torch.where(torch.logical_and(there, reached), 0.0, 1.0)], -1)

    def _coordinates(self, pose: Tensor, shift: Tensor) -> Tensor:
        """Pose coordinates `... x p` of a small shift `... x c` of the frame."""
        rows = pose.reshape(-1, pose.shape[-1])
        found = self._closed[0].coordinates(rows, shift.reshape(-1, shift.shape[-1]))
        return found.reshape(pose.shape)


def _where_there(found: Tensor, aim: Tensor) -> Tensor:
    """A correction, 0 where the machine cannot take the pose."""
    there = torch.where(aim[..., -1:] <= 0, found, torch.zeros_like(found))
    return torch.where(torch.isfinite(found), there, torch.zeros_like(found))


def build_machine(
    mechanism: Mechanism,
    identified: Tensor,
    effects: PhysicalEffects | None,
    joints: Tensor,
    margin: float,
    rule: Rule = RULE,
) -> Machine | None:
    """The machine of a compensator; None for one without a closed form in either direction.

    Args:
        mechanism: with the nominal parameters, fitted frames included.
        identified: all parameters, `k` [SI].
        effects: on joints and pose; None without any.
        joints: commanded joints of the training rows, `s x n` [SI].
        margin: of the compensator's domain.

    Raises:
        InputError, MethodFailedError: as `expand`.
    """
    if isinstance(mechanism, SerialArm) or mechanism.closed_form == "forward":
        return Machine(mechanism, identified, effects, rule)
    if mechanism.closed_form != "inverse":
        return None
    start = expand(lambda q: mechanism.forward_kinematics(q), joints, margin, "pose", worst=_START)
    made = InverseMachine(mechanism, identified, effects, rule, start)
    made.newton = max(one.steps_needed(joints, _MOST_NEWTON) for one in made._closed)
    return made
