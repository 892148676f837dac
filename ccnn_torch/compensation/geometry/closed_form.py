"""Kinematics with a closed form of one direction, and their derivatives, in sums, products and roots alone."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.geometry.chebyshev import ChebyshevExpansion
from ccnn_torch.compensation.geometry.matrices import inverse
from ccnn_torch.mechanisms import Mechanism

# Of central differences of the fourth order [SI]: machines are about 1 m, and their kinematics are curved by about 1/m.
_STEP = 5e-4
# From a polynomial that is off by some hundredths at most, and by 1e-4 mostly.
_NEWTON_STEPS = 4
# What is left of the inverse kinematics where a pose was found [SI].
_FOUND = 1e-9
# How far a further step may move the pose of one that has settled [m, rad].
_SETTLED = 1e-13
# A Jacobian that no machine has [m or rad per joint unit].
_LOST = 1e9


class ClosedKinematics(nn.Module):
    """Pose, frame and derivatives of a mechanism with nominal parameters, by closed forms and central differences.

    Differences are right to about 1e-11 of the derivative away from singular poses. Where the mechanism has no such
    pose everything is as in its home pose, but the Jacobian is out of all proportion.

    Attributes:
        start: polynomial from which Newton's method finds the pose, where only the inverse kinematics are closed.
    """

    def __init__(self, mechanism: Mechanism, start: ChebyshevExpansion | None) -> None:
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
            found["jacobian"] = frame_slope(lambda q: mechanism.frame(mechanism.forward_kinematics(q)), joints)
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
        pose = self.start(joints).detach()
        for _ in range(_NEWTON_STEPS):
            pose = self._newton(pose, joints).detach()
        # A comparison with NaN is false.
        reachable = ((mechanism.solve_inverse(pose) - joints).abs() < _FOUND).all(-1, keepdim=True)
        joints = torch.where(reachable, joints, mechanism.home_joints)
        # The last step has the derivative by the joints.
        return joints, self._newton(torch.where(reachable, pose, mechanism.home_pose), joints), reachable

    def _newton(self, pose: Tensor, joints: Tensor) -> Tensor:
        inverse = self._mechanism[0].solve_inverse
        step = _pseudo_inverse(_slope(inverse, pose)) @ (inverse(pose) - joints).unsqueeze(-1)
        return pose - step.squeeze(-1)


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
    turn = rotations @ rotation.mT
    skew = (turn - turn.mT) * torch.tensor(0.5, dtype=turn.dtype)
    turned = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    return torch.cat([_difference(positions), _difference(turned)], -2)


def _pseudo_inverse(matrix: Tensor) -> Tensor:
    """Of `s x o x k` with independent columns, `s x k x o`."""
    return inverse(matrix.mT @ matrix) @ matrix.mT
