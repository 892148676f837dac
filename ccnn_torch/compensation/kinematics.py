"""Where a machine's frame is and how its joints move it, in operators that every export has: no solver, no pivoting."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.expansions import ChebyshevExpansion
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import homogeneous, rotation_vector_to_matrix, skew, vee

# Of central differences of the fourth order [SI]: machines are about 1 m, and their kinematics are curved by about 1/m.
_STEP = 5e-4
# From a polynomial that is off by some hundredths at most, and by 1e-4 mostly, with the derivative there.
_NEWTON_STEPS = 8
# What is left of the inverse kinematics where a pose was found [SI].
_FOUND = 1e-9
# How far a further step may move the pose of one that has settled [m, rad].
_SETTLED = 1e-13
# A Jacobian that is none, and from where on no machine has one [m or rad per joint unit].
_LOST, _STEEPEST = 1e9, 1e6
# Cosines of a right angle and their products with lengths: rounding [1 or m], and as zeros they cost nothing.
_NOTHING = 1e-15


def gauss_jordan(matrix: Tensor, right: Tensor) -> Tensor:
    """Solution of a positive definite `... x n x n`, right `... x n x c`: without pivoting, unrolled."""
    table = torch.cat([matrix, right], dim=-1)
    count = matrix.shape[-1]
    unit = torch.eye(count, dtype=matrix.dtype)
    for k in range(count):
        row = table[..., k : k + 1, :] / table[..., k : k + 1, k : k + 1]
        table = table - (table[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return table[..., count:]


def inverse(matrix: Tensor) -> Tensor:
    """Inverse of a positive definite `... x n x n`."""
    return gauss_jordan(matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype).expand_as(matrix))


class Placed(NamedTuple):
    """The frame of the pose, and its derivative.

    Attributes:
        position: `... x 3` [m].
        rotation: `... x 3 x 3`; None where the pose has no orientation.
        linear, turning: velocity and rate of rotation by each joint, base frame, `... x n x 3` [m, rad per joint unit].
        lost: 1 where the machine has no such pose, else 0, `... x 1`; None where it has one everywhere.
    """

    position: Tensor
    rotation: Tensor | None
    linear: Tensor
    turning: Tensor
    lost: Tensor | None = None

    def shifted(self, shift: Tensor) -> Placed:
        """Moved by position and rotation vector `... x c` [m, rad] in the base frame; the derivative is kept.

        The exponential of the rotation is its series, right to rounding below 0.3 rad.
        """
        position = self.position + shift[..., :3]
        if self.rotation is None or shift.shape[-1] == 3:
            return self._replace(position=position)
        vector = shift[..., 3:]
        turn = skew(vector)
        square = (vector * vector).sum(-1)[..., None, None]
        sine = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
        cosine = (1 - square / 12 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90)))) / 2
        rotation = self.rotation + (sine * turn + cosine * (turn @ turn)) @ self.rotation
        return self._replace(position=position, rotation=rotation)


class ClosedKinematics(nn.Module):
    """Pose, frame and derivatives of a mechanism with nominal parameters, by closed forms and central differences.

    Differences are right to about 1e-11 of the derivative away from singular poses. Where the mechanism has no such
    pose everything is as in its home pose, but the Jacobian is out of all proportion.

    Attributes:
        start: polynomial from which Newton's method finds the pose, where only the inverse kinematics are closed.
    """

    def __init__(self, mechanism: Mechanism, start: ChebyshevExpansion | None = None) -> None:
        super().__init__()
        # In a tuple, since the mechanism's own buffers are no part of the model.
        self._mechanism = (mechanism,)
        self.start = start

    def quantities(self, joints: Tensor, names: set[str]) -> dict[str, Tensor]:
        """What a `Situation` calls by these names, and the pose, at joints `s x n`."""
        mechanism = self._mechanism[0]
        joints, pose, reachable = self._standing(joints)
        found = {"pose": pose}
        needed = self.start is not None or names & {"frame_slope", "holding", "visible"}
        seen = frame_slope(mechanism.frame, pose) if needed else pose
        if self.start is None:
            found["jacobian"] = self._forward_slope(joints)
        else:
            found["jacobian"] = seen @ _pseudo_inverse(_slope(mechanism.solve_inverse, pose))
        if "parameter_jacobian" in names:
            values = mechanism.nominal.expand(joints.shape[0], -1)
            if self.start is None:
                found["parameter_jacobian"] = frame_slope(
                    lambda p: mechanism.frame(mechanism.forward_kinematics(joints, p)), values
                )
            else:
                rates = _slope(lambda p: mechanism.solve_inverse(pose, p), values)
                found["parameter_jacobian"] = -found["jacobian"] @ rates
        found["jacobian"] = torch.where(
            reachable.unsqueeze(-1), found["jacobian"], torch.full_like(pose[:1, :1, None], _LOST)
        )
        if "frame_slope" in names:
            found["frame_slope"] = seen
        if "holding" in names:
            found["holding"] = _pseudo_inverse(seen).mT
        if "visible" in names:
            found["visible"] = seen @ _pseudo_inverse(seen)
        return found

    def at(self, joints: Tensor) -> Placed:
        """By forward kinematics at joints `... x n` [SI]; the home pose, which nothing moves, where there is none."""
        lead = joints.shape[:-1]
        stand, pose, there = self._standing(joints.reshape(-1, joints.shape[-1]))
        position, rotation = self._mechanism[0].frame(pose)
        rates = self._forward_slope(stand).mT
        # At the edge of what it reaches a neighbour has no pose.
        steep = torch.relu(rates.abs() - _STEEPEST).sum((-2, -1)).unsqueeze(-1)
        there = torch.logical_and(there, steep <= 0)
        rates = torch.where(there.unsqueeze(-1), rates, torch.zeros_like(rates))

        def shaped(value: Tensor) -> Tensor:
            return value.reshape(*lead, *value.shape[1:])

        turned = None if rotation is None else shaped(rotation)
        lost = torch.where(there, 0.0, 1.0)
        return Placed(shaped(position), turned, shaped(rates[..., :3]), shaped(rates[..., 3:]), shaped(lost))

    def _forward_slope(self, joints: Tensor) -> Tensor:
        mechanism = self._mechanism[0]
        return frame_slope(lambda q: mechanism.frame(mechanism.forward_kinematics(q)), joints)

    def standing(self, joints: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Pose coordinates at joints `... x n`, `... x p` [SI], and whether it is theirs and not the home, `... x 1`.

        By so many steps of Newton's method from the polynomial, all with the derivative there.
        """
        mechanism, rows = self._mechanism[0], joints.reshape(-1, joints.shape[-1])
        found = self._steps(rows, steps)
        near = torch.relu((mechanism.solve_inverse(found) - rows).abs() - _FOUND).sum(-1, keepdim=True)
        # A comparison with NaN is false.
        pose = torch.where(near <= 0, found, mechanism.home_pose)
        lead = joints.shape[:-1]
        return pose.reshape(*lead, -1), (near <= 0).reshape(*lead, 1)

    def _steps(self, rows: Tensor, steps: int) -> Tensor:
        inverse_kinematics = self._mechanism[0].solve_inverse
        assert self.start is not None
        pose: Tensor = self.start(rows)
        # A derivative that is none counts as large, and the pose stays where it is.
        lift = _pseudo_inverse(_slope(inverse_kinematics, pose))
        for _ in range(steps):
            pose = pose - (lift @ (inverse_kinematics(pose) - rows).unsqueeze(-1)).squeeze(-1)
        return pose

    def steps_needed(self, joints: Tensor, most: int) -> int:
        """Steps of `standing` after which the pose of joints `s x n` has settled; `most` where it has not."""
        for steps in range(1, most):
            apart = (self._steps(joints, steps) - self._steps(joints, steps + 1)).abs()
            if bool((apart <= _SETTLED).all()):
                return steps
        return most

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Position `... x 3` [m] and rotation `... x 3 x 3` of a machine that turns, at pose coordinates `... x p`."""
        position, rotation = self._mechanism[0].frame(pose)
        assert rotation is not None
        return position, rotation

    def coordinates(self, pose: Tensor, shift: Tensor) -> Tensor:
        """Pose coordinates `s x p` of a small shift of the frame at a pose, `s x c` [m, rad]."""
        seen = frame_slope(self._mechanism[0].frame, pose)
        found: Tensor = (_pseudo_inverse(seen) @ shift.unsqueeze(-1)).squeeze(-1)
        return found

    def _standing(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Joints and poses that the mechanism can take: those at hand, or its home; and which, `s x 1`."""
        mechanism = self._mechanism[0]
        if self.start is None:
            pose = mechanism.forward_kinematics(joints)
            reachable = torch.isfinite(pose).all(-1, keepdim=True)
            joints = torch.where(reachable, joints, mechanism.home_joints)
            return joints, torch.where(reachable, pose, mechanism.home_pose), reachable
        pose, reachable = self.standing(joints, _NEWTON_STEPS)
        return torch.where(reachable, joints, mechanism.home_joints), pose, reachable


def _slope(function: Callable[[Tensor], Tensor], point: Tensor) -> Tensor:
    """Derivative of `s x k` -> `s x o` by central differences, `s x o x k`; `_LOST` where a neighbour is no number."""
    return _difference(function(_neighbours(point)))


def _neighbours(point: Tensor) -> Tensor:
    """All of `s x k` that the derivative needs, `4 x k x s x k`: a graph is as long as its calls are many."""
    step, unit = torch.tensor(_STEP, dtype=point.dtype), torch.eye(point.shape[-1], dtype=point.dtype)
    return point + torch.stack([unit, -unit, 2 * unit, -2 * unit]).unsqueeze(-2) * step


def _difference(values: Tensor) -> Tensor:
    """The derivative out of the values at `_neighbours`, `4 x k x s x o`."""
    near, before, far, behind = values.unbind(0)
    slope = (8 * (near - before) - (far - behind)) / (12 * torch.tensor(_STEP, dtype=values.dtype))
    # An edge of the workspace is as near as that, and there the Jacobian is out of all proportion.
    return torch.nan_to_num(slope, nan=_LOST, posinf=_LOST, neginf=-_LOST).permute(1, 2, 0)


def frame_slope(function: Callable[[Tensor], tuple[Tensor, Tensor | None]], point: Tensor) -> Tensor:
    """Derivative of position and rotation vector (base frame) of a frame, `s x c x k`; see `frame_jacobian`."""
    positions, rotations = function(_neighbours(point))
    if rotations is None:
        return _difference(positions)
    rotation = function(point)[1]
    assert rotation is not None
    # The skew part of dR Rᵀ is the rotation vector's, and its second order is symmetric.
    return torch.cat([_difference(positions), _difference(vee(rotations @ rotation.mT))], -2)


def _pseudo_inverse(matrix: Tensor) -> Tensor:
    """Of `s x o x k` with independent columns, `s x k x o`."""
    return inverse(matrix.mT @ matrix) @ matrix.mT


class Links(nn.Module):
    """One geometry of an arm: where its tool is, and how the joints move it."""

    _links: Tensor
    _spins: Tensor
    _shifts: Tensor
    _slides: Tensor
    _turns: Tensor
    _coupled: Tensor | None
    _own: Tensor | None

    def __init__(self, arm: Mechanism) -> None:
        super().__init__()
        assert isinstance(arm, SerialArm)
        self._turned = arm.orientation == "rotation_vector"
        links = _links(arm)
        spins, shifts = _screws(links)
        curved = arm.own_drives.curved
        for name, value in {
            "_links": links,
            "_spins": spins,
            "_shifts": shifts,
            "_slides": (~arm.revolute).to(torch.float64),
            "_turns": arm.revolute.to(torch.float64),
            "_coupled": None if curved else arm.coupled(arm.home_joints, arm.nominal),
            "_own": arm.of_drives(arm.nominal) if curved else None,
        }.items():
            self.register_buffer(name, value, persistent=False)
        self._drives = arm.own_drives

    def at(self, joints: Tensor) -> Placed:
        """At joints `... x n` [SI]."""
        coupled = self._coupled
        if self._own is not None:
            coupled, joints = self._drives.coupled(joints, self._own), self._drives.moved(joints, self._own)
        elif coupled is not None:
            joints = joints @ coupled.mT
        turned, other = torch.cos(joints) * self._turns, torch.sin(joints) * self._turns + joints * self._slides
        moved = turned[..., None, None] * self._links[0] + other[..., None, None] * self._links[1] + self._links[2]
        chain = [moved[..., 0, :, :]]
        for link in moved.unbind(-3)[1:]:
            chain.append(chain[-1] @ link)
        ends = torch.stack(chain, dim=-3)
        rotations, lever = ends[..., :3, :3], chain[-1][..., None, :3, 3] - ends[..., :3, 3]
        spins = (rotations @ self._spins)[..., 0]
        linear = (rotations @ self._shifts)[..., 0] + torch.linalg.cross(spins, lever, dim=-1)
        rotation = chain[-1][..., :3, :3] if self._turned else None
        if coupled is not None:
            linear, spins = coupled.mT @ linear, coupled.mT @ spins
        return Placed(chain[-1][..., :3, 3], rotation, linear, spins)


def _links(arm: SerialArm) -> Tensor:
    """`cos q`, `sin q` (or q of a prismatic joint) and constant part of every link's transform, `3 x n x 4 x 4`.

    The base comes before the first link and the tool after the last one.
    """
    values = arm.nominal

    def at(q: float) -> Tensor:
        joints = torch.full((len(arm.joints),), q, dtype=torch.float64)
        return homogeneous(*arm.link_transforms(joints, values))

    zero, quarter, half = at(0.0), at(math.pi / 2), at(math.pi)
    turns = arm.revolute[:, None, None]
    constant = torch.where(turns, (zero + half) / 2, zero)
    cosine = torch.where(turns, (zero - half) / 2, 0.0)
    other = torch.where(turns, quarter - constant, (half - zero) / math.pi)
    links = torch.stack([cosine, other, constant])
    base = homogeneous(rotation_vector_to_matrix(values[3:6]), values[:3])
    tool = homogeneous(rotation_vector_to_matrix(values[-3:]), values[-6:-3])
    links[:, 0] = base @ links[:, 0]
    links[:, -1] = links[:, -1] @ tool
    return torch.where(links.abs() < _NOTHING, 0.0, links)


def _screws(links: Tensor) -> tuple[Tensor, Tensor]:
    """What each joint does to what is behind it, in the frame of its own link's end: rotation and velocity of the
    frame's origin per joint unit, `n x 3 x 1` each, from links `3 x n x 4 x 4`.

    A link is `K Rot(q) L` or `K Shift(q) L` with constant K and L, so that its derivative is the link times a constant.
    """
    rate = torch.linalg.solve(links[0] + links[2], links[1])
    rate = torch.where(rate.abs() < _NOTHING, 0.0, rate)
    return vee(rate[..., :3, :3])[..., None], rate[..., :3, 3:]
