"""Machines whose joints of a pose are searched: damped Newton to the closest pose that they reach."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.newton import carry_derivative, least_norm
from ccnn_torch.mechanisms.pose import Frame, frame_gap
from ccnn_torch.numerics.batching import expand_leading
from ccnn_torch.numerics.least_squares import levenberg_marquardt

# First damping of a search whose solutions may be more than one [1].
_DAMPING = 1e-8


class Closest(Mechanism):
    """A mechanism that gives `forward_kinematics`, `jacobian` and `sample_joints`, and searches the rest.

    Attributes:
        rotation_weight: of orientation against position in `solve_inverse` [m/rad].
    """

    rotation_weight = 0.04

    def _frame_at(self, joints: Tensor, values: Tensor, rows: Tensor) -> Frame:
        """Frame of the joints `... x n`; rows: poses `... x p` near by."""
        return self.frame(self.forward_kinematics(joints, values, rows))

    def sample_workspace(self, count: int, generator: torch.Generator) -> Tensor:
        """Poses of sampled joints, `count x p` [SI]."""
        return self.forward_kinematics(self.sample_joints(count, generator))

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Position difference [m] and rotation vector [rad] from the pose to that of the joints, `... x 6` or `x 3`."""
        return frame_gap(self._frame_at(joints, self.resolve(parameters), pose), self.frame(pose), 1.0)

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Joints of the closest pose, as `nearest_joints`. Never NaN: `pose_error` gives the distance that remains."""
        values, weights = self.resolve(parameters), self.channel_weights(self.rotation_weight)
        found = self.nearest_joints(pose, values, guess, self.rotation_weight)
        slope = torch.nan_to_num(self.jacobian(found, values.detach(), pose.detach())) * weights[:, None]
        return carry_derivative(found, slope, self.closure(pose, found, values) * weights)

    def nearest_joints(
        self,
        pose: Tensor,
        parameters: Tensor | None,
        guess: Tensor | None,
        rotation_weight: float,
        damping: float = 0.0,
    ) -> Tensor:
        """Joints whose pose is closest in (position, rotation_weight x rotation vector), by damped Newton from `guess`.

        Where joints are more than what is compared (redundant arms, poses without orientation) the deviation from the
        guess has the least norm. With `damping` [m per joint unit] the squared deviation times damping² is part of what
        is minimised, which bounds it near singularities. No gradient flows through this; it does through
        `solve_inverse`.
        """
        values, weights = self.resolve(parameters), self.channel_weights(rotation_weight)
        position, rotation = self.frame(pose)
        anchor = expand_leading(self.home_joints if guess is None else guess, position, values).detach()
        ridge = damping * torch.eye(anchor.shape[-1], dtype=anchor.dtype)

        def residual(q: Tensor, start: Tensor, v: Tensor, rows: Tensor, place: Tensor, *turn: Tensor) -> Tensor:
            goal = place, turn[0].reshape(*place.shape[:-1], 3, 3) if turn else None
            left = frame_gap(self._frame_at(q, v, rows), goal, 1.0) * weights
            return torch.cat([left, damping * (q - start)], dim=-1) if damping else left

        def slope(q: Tensor, _: Tensor, v: Tensor, rows: Tensor, *goal: Tensor) -> Tensor:
            found = torch.nan_to_num(self.jacobian(q, v, rows)) * weights[:, None]
            return torch.cat([found, ridge.expand(*q.shape[:-1], -1, -1)], dim=-2) if damping else found

        goal = (position,) if rotation is None else (position, rotation.flatten(-2))
        plain = (anchor, *(d.detach() for d in (values, pose, *goal)))
        found = levenberg_marquardt(residual, anchor, slope, plain, tolerance=1e-10, damping=_DAMPING)
        if damping or len(self.joints) <= self.compared:
            return found.value
        return least_norm(residual, slope, found, anchor, plain)
