"""Joints of commanded poses on the branch (shoulder, elbow, wrist) on which an arm's rows fit best."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.mechanisms.branches import ROUNDED, arrives
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, fit_frames
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.pose import frame_gap

# Initial guesses of the joints of a pose; solutions nearer to each other than this are one [rad, m].
_STARTS, _SAME = 64, 1e-3
# Poses of the search, what is rounding [m, rad], and poses whose solutions start it.
_GOALS, _ROUNDING, _REFERENCES = 200, 1e-6, 4
# Standard deviation of the noise to that of a parameter: 30 µm to 1 mm.
_RIDGE = 0.03
_ROUNDS = 30
# Other joints are taken where they leave less than this share of the squares; within the second one they fit alike.
_BETTER, _ALIKE = 0.5, 1.5


class _Goals(NamedTuple):
    """Of each of g commanded poses the m solutions, the first of them given, and what was measured there.

    Attributes:
        joints: `g x m x n` [SI].
        there: whether a pose has so many solutions, `g x m` bool.
        gaps: from the nominal pose to the measured one, times the root of the number of rows, `g x c` [m].
        slopes: their derivative by the parameters, `g x m x c x k`.
    """

    joints: Tensor
    there: Tensor
    gaps: Tensor
    slopes: Tensor

    def left(self, choice: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A ridge regression on chosen solutions, `s x g`.

        Returns:
            The squares that it leaves at all of them, `s x g x m`; its cost, `s`; the sum of its parameters' absolute
            values, `s`.
        """
        rows = self.slopes[torch.arange(len(self.gaps)), choice].flatten(1, 2)
        ridge = _RIDGE**2 * torch.eye(rows.shape[-1], dtype=rows.dtype)
        found = torch.linalg.solve(rows.mT @ rows + ridge, rows.mT @ self.gaps.flatten()[:, None])[..., 0]
        explained = torch.einsum("gmck,sk->sgmc", self.slopes, found)
        squares = torch.where(self.there, (self.gaps[:, None] - explained).square().sum(-1), torch.inf)
        cost = self.of(squares, choice).sum(-1) + _RIDGE**2 * found.square().sum(-1)
        return squares, cost, found.abs().sum(-1)

    @staticmethod
    def of(values: Tensor, choice: Tensor) -> Tensor:
        """Of values `... x g x m` those of the chosen solutions, `... x g`."""
        return values.expand(*choice.shape, -1).gather(-1, choice[..., None])[..., 0]


def fitting_branches(arm: SerialArm, joints: Tensor, measured: Tensor) -> tuple[Tensor, str]:
    """Joints of the same poses with which errors of the geometry explain the most, and what to say of them.

    Which joints an arm had follows from how its errors move the tool: a ridge regression of all its parameters on the
    rows, and for each pose the solution that this leaves the least at, in turn until nothing changes. It starts from
    the joints given, and from the solutions nearest to each of some poses. Of those that fit alike
    that of the smallest errors counts, by the sum of their absolute values; the joints given where none fits better.

    Args:
        joints: `s x n` [SI], on any branch.
        measured: poses, `s x 6`, or `s x 3` of positions [SI].

    Returns:
        The joints, `s x n`, and a sentence on those that stay in doubt, if any; the joints given and "" where there
        are no others, no error, or more poses than are searched.
    """
    machine = arm.controlled() if len(arm.joints) > 3 else arm.controlled().with_orientation("none")
    poses, row = torch.unique((machine.forward_kinematics(joints) / _ROUNDING).round(), dim=0, return_inverse=True)
    if len(arm.joints) > 6 or arm.grouped or len(poses) > _GOALS or not bool(measured.isfinite().all(-1).any()):
        return joints, ""
    goals = _goals(arm, machine, joints, measured, row)
    if goals is None:
        return joints, ""
    given = torch.zeros(1, len(poses), dtype=torch.long)
    near = goals.joints[:_REFERENCES][goals.there[:_REFERENCES]]
    far = machine.wrap(goals.joints - near[:, None, None]).norm(dim=-1)
    choices = torch.cat([given, torch.where(goals.there, far, torch.inf).argmin(-1)])
    for _ in range(_ROUNDS):
        squares = goals.left(choices)[0]
        other = squares.argmin(-1)
        better = goals.of(squares, other) < _BETTER * goals.of(squares, choices)
        if not bool(better.any()):
            break
        choices = torch.where(better, other, choices)
    _, cost, size = goals.left(choices)
    alike = cost <= _ALIKE * cost.min()
    taken = choices[int(torch.where(alike, size, torch.inf).argmin())]
    if float(cost.min()) > _BETTER * float(goals.left(given)[1]):
        taken = given[0]
    squares = goals.left(taken[None])[0][0]
    doubted = ((squares <= _ALIKE**2 * goals.of(squares, taken)[:, None]).sum(-1) > 1) | (choices[alike] != taken).any(
        0
    )
    # Full turns as those of the joints given.
    found = joints + machine.wrap(goals.joints[torch.arange(len(poses)), taken][row] - joints)
    if not bool(doubted.any()):
        return found, ""
    return found, (
        f"the joints of {int(doubted.sum())} of {len(poses)} commanded poses may be those of another shoulder, elbow "
        f"or wrist, which fit as well; columns guess_{arm.joints[0].header} … guess_{arm.joints[-1].header} near the "
        "true joints tell"
    )


def _goals(arm: SerialArm, machine: SerialArm, joints: Tensor, measured: Tensor, row: Tensor) -> _Goals | None:
    """The commanded poses with all their solutions; None without an error. row: number of the pose of each row, `s`."""
    own = arm if measured.shape[-1] == len(arm.pose) else arm.with_orientation("none")
    good = measured.isfinite().all(-1)
    values = fit_frames(own, joints[good], measured[good]) if own.unknown_frames else own.nominal
    gaps = frame_gap(own.frame(measured[good]), own.forward_frame(joints[good], values), ROTATION_WEIGHT)
    if float(gaps.square().mean()) < _ROUNDING**2:
        return None
    first = torch.stack([torch.nonzero(row == k)[0, 0] for k in range(int(row.max()) + 1)])
    found = _solutions(machine, joints[first])
    there = found.isfinite().all(-1)
    weights = torch.ones(gaps.shape[-1], dtype=joints.dtype)
    weights[3:] = ROTATION_WEIGHT
    count = torch.zeros(len(first), 1, dtype=joints.dtype).index_add(0, row[good], torch.ones_like(gaps[:, :1]))
    total = torch.zeros(len(first), len(weights), dtype=joints.dtype).index_add(0, row[good], gaps)
    found = found.nan_to_num()
    slopes = own.parameter_jacobian(found, values) * (weights[:, None] * count.sqrt()[:, None, None])
    return _Goals(found, there, total / count.clamp_min(1).sqrt(), slopes)


def _solutions(machine: SerialArm, joints: Tensor) -> Tensor:
    """All solutions for the poses of joints `g x n`, these the first, `g x m x n` [SI]; NaN where there are fewer."""
    poses = machine.forward_kinematics(joints)[:, None].expand(-1, _STARTS, -1)
    starts = machine.sample_joints(_STARTS, torch.Generator().manual_seed(0))
    found = machine.solve_inverse(poses, guess=starts).detach()
    # A solution outside the limits is no joint of this arm; its limits are a full turn where the file has none.
    inside = machine.wrap(found - machine.limits.mean(-1)).abs() <= (machine.limits[:, 1] - machine.limits[:, 0]) / 2
    good = arrives(machine, found, poses, ROUNDED) & (inside | ~machine.revolute).all(-1)
    every = torch.cat([joints[:, None], found], 1)
    alike = (machine.wrap(every[:, :, None] - every[:, None]).abs() < _SAME).all(-1).tril(-1)
    first = torch.cat([torch.ones_like(good[:, :1]), good], 1)
    for k in range(1, _STARTS + 1):
        first[:, k] &= ~(alike[:, k] & first).any(-1)
    kept = int(first.sum(-1).max())
    order = first.double().argsort(dim=-1, descending=True, stable=True)[:, :kept]
    every = torch.where(first[..., None], every, torch.nan)
    return every.gather(1, order[..., None].expand(-1, -1, every.shape[-1]))
