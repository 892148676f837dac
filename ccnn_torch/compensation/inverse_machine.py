"""A machine whose inverse kinematics alone are a closed form, and the frames that it is seen through."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.effects import PhysicalEffects
from ccnn_torch.compensation.expansions import ChebyshevExpansion
from ccnn_torch.compensation.kinematics import ClosedKinematics
from ccnn_torch.compensation.machine import RULE, ForwardMachine, Rule
from ccnn_torch.mechanisms import Framed, Mechanism
from ccnn_torch.mechanisms.machines.links import compose, transform_of
from ccnn_torch.numerics.rotations import vee

MOST_NEWTON = 8
"""Steps of Newton's method to a pose, at most."""


def inner_of(mechanism: Mechanism) -> Mechanism:
    """The machine itself, without the frames that it is seen through."""
    return mechanism.mechanism if isinstance(mechanism, Framed) else mechanism


class Frames(nn.Module):
    """What lies between the poses of a nominal and an identified machine whose frames differ a little.

    Both machines are seen through base and tool frames B F(q) T. A pose that is wanted of the identified one is
    F' = (B⁻¹ B')⁻¹ F (T' T⁻¹)⁻¹ of the machine inside.

    Attributes:
        inside: pose, frame and derivatives of the machine inside.
    """

    # Of Newton's method, from a pose that is off by what was identified.
    _STEPS = 3

    def __init__(self, mechanism: Framed, identified: Tensor, inside: ClosedKinematics) -> None:
        super().__init__()
        (base, _, tool), (real_base, _, real_tool) = mechanism.split(mechanism.nominal), mechanism.split(identified)
        before, after = transform_of(real_base), transform_of(real_tool)
        # Products of two rotations, row by row: rotation and shift.
        self._out = compose(_backward(transform_of(base)), before), compose(after, _backward(transform_of(tool)))
        self._in = _backward(self._out[0]), _backward(self._out[1])
        self._turn, self._lever = before[0], after[1]
        # In a tuple, since the polynomial is stored once.
        self._inside = (inside,)

    def into(self, pose: Tensor) -> Tensor:
        """Pose coordinates `... x p` of the identified machine inside, where the nominal one would have these."""
        return self._moved(pose, self._in)

    def out_of(self, pose: Tensor) -> Tensor:
        """The other way."""
        return self._moved(pose, self._out)

    def shift(self, pose: Tensor, seen: Tensor) -> Tensor:
        """A small shift of the frame that is seen, `... x 6` [m, rad], as one of the machine inside, at its pose."""
        turn, moved = (seen[..., k : k + 3] @ self._turn for k in (3, 0))
        _, rotation = self._inside[0].frame(pose)
        lever = (rotation @ self._lever.unsqueeze(-1)).squeeze(-1)
        return torch.cat([moved - torch.linalg.cross(turn, lever, dim=-1), turn], -1)

    def _moved(self, pose: Tensor, by: tuple[_Transform, _Transform]) -> Tensor:
        inside, rows = self._inside[0], pose.reshape(-1, pose.shape[-1])
        position, rotation = inside.frame(rows)
        rotation, position = compose(compose(by[0], (rotation, position)), by[1])
        for _ in range(self._STEPS):
            place, turn = inside.frame(rows)
            gap = torch.cat([position - place, vee(rotation @ turn.mT)], -1)
            rows = rows + inside.coordinates(rows, gap)
        return rows.reshape(pose.shape)


_Transform = tuple[Tensor, Tensor]


def _backward(by: _Transform) -> _Transform:
    return by[0].mT, -(by[0].mT @ by[1])


class InverseMachine(ForwardMachine):
    """g(P⁻¹(X, c); θ) - e_joints: every step finds the joints that the identified machine has at the pose.

    Poses X are those of the machine inside, where it is seen through frames.

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
        newton: int = MOST_NEWTON,
    ) -> None:
        assert start is not None
        super().__init__(mechanism, identified, effects, rule)
        self.start = start
        nominal, real = inner_of(mechanism), inner_of(self.real)
        # In a tuple, since the polynomial is stored once.
        self._closed = (ClosedKinematics(nominal, start), ClosedKinematics(real, start))
        self._frames = Frames(mechanism, identified, self._closed[0]) if isinstance(mechanism, Framed) else None
        self._solve, self._numbers = nominal.solve_inverse, (nominal.nominal, real.nominal)
        self.newton = newton

    def aim(self, joints: Tensor) -> Tensor:
        """Pose coordinates `... x p` [SI], and 1 where the machine cannot take the pose."""
        pose, there = self._closed[0].standing(joints, self.newton)
        pose = pose if self._frames is None else self._frames.into(pose)
        return self._flat_pose(pose, there, self._numbers[1])

    def aim_back(self, command: Tensor, learned: Tensor, covariates: Tensor) -> Tensor:
        moved = command + learned
        joints, shift = (None, None) if self.effects is None else self.effects.changes(moved, covariates)
        pose, there = self._closed[1].standing(moved if joints is None else moved + joints, self.newton)
        pose = pose if shift is None else pose + self._coordinates(pose, shift)
        pose = pose if self._frames is None else self._frames.out_of(pose)
        return self._flat_pose(pose, there, self._numbers[0])

    def next_correction(
        self, learned: Tensor, covariates: Tensor, ideal: Tensor, correction: Tensor, aim: Tensor
    ) -> Tensor:
        moved = ideal - correction + learned
        joints, shift = (None, None) if self.effects is None else self.effects.changes(moved, covariates)
        pose = aim[..., :-1]
        pose = pose if shift is None else pose - self._coordinates(pose, shift)
        # Command and what is added to it are the joints of the real machine.
        added = learned if joints is None else learned + joints
        return _where_there(ideal - self._solve(pose, self._numbers[1]) + added, aim)

    def next_back(self, command: Tensor, correction: Tensor, aim: Tensor) -> Tensor:
        return _where_there(command - self._solve(aim[..., :-1], self._numbers[0]), aim)

    def description(self) -> dict[str, Any]:
        return super().description() | {"degree": self.start.degree, "newton": self.newton}

    @classmethod
    def _blank(cls, mechanism: Mechanism, description: dict[str, Any]) -> dict[str, Any]:
        unit = torch.ones(len(mechanism.joints), dtype=torch.float64)
        polynomial = ChebyshevExpansion(
            unit, unit.clone(), description["degree"], outputs=len(inner_of(mechanism).pose)
        )
        return {"start": polynomial, "newton": description["newton"]}

    def _prepare(self) -> None:
        pass

    def _flat_pose(self, pose: Tensor, there: Tensor, values: Tensor) -> Tensor:
        """Pose coordinates, and 0 where they are reached with these parameters, too, else 1."""
        reached = torch.isfinite(self._solve(pose, values)).all(-1, keepdim=True)
        return torch.cat([pose, torch.where(torch.logical_and(there, reached), 0.0, 1.0)], -1)

    def _coordinates(self, pose: Tensor, shift: Tensor) -> Tensor:
        """Pose coordinates `... x p` of a small shift `... x c` of the frame."""
        rows = pose.reshape(-1, pose.shape[-1])
        shift = shift.reshape(-1, shift.shape[-1])
        shift = shift if self._frames is None else self._frames.shift(rows, shift)
        found = self._closed[0].coordinates(rows, shift)
        return found.reshape(pose.shape)


def _where_there(found: Tensor, aim: Tensor) -> Tensor:
    """A correction, 0 where the machine cannot take the pose."""
    there = torch.where(aim[..., -1:] <= 0, found, torch.zeros_like(found))
    return torch.where(torch.isfinite(found), there, torch.zeros_like(found))
