"""Base and tool frame of a serial arm from measured poses: measured data never says where the arm stands."""

from __future__ import annotations

from dataclasses import dataclass

import roma
import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.least_squares import levenberg_marquardt
from ccnn_torch.mechanisms._pose import Frame, frame_jacobian
from ccnn_torch.mechanisms.serial import SerialArm
from ccnn_torch.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix, skew

__all__ = ["fit_frames"]


def fit_frames(
    arm: SerialArm, joints: Tensor, pose: Tensor, weights: Tensor | None = None, rotation_weight: float = 0.3
) -> Tensor:
    """Fit the unknown ones of base and tool frame to rows, nominal links kept; each repeat on its own rows.

    With orientation both frames are fitted in (position, rotation_weight x rotation vector); without, the base frame
    and the tool's position (the tool's rotation is then nothing that the rows could tell and stays nominal). The start
    is a closed form, so there is no wrong basin to fall into: Shah's solution of A X = Z B by a singular value
    decomposition (Shah 2013) with orientation, a linear relaxation of the base rotation without.

    Args:
        arm: the arm; `arm.unknown_frames` says what is fitted.
        joints: `s x n` [SI].
        pose: measured, `s x p` [SI].
        weights: `r x s` or `s` [1]; 0 leaves a row out (held-out rows); all 1 when None.
        rotation_weight: [m/rad]; 0.3 weighs 1 mrad as 0.3 mm, about an arm's ratio of orientation to position errors.

    Returns:
        All parameters, `r x k` [SI] (`k` when the weights have no repeats).

    Raises:
        InputError: too few rows, or the arm has frames per group.
    """
    if arm.frame_per or arm.tool_per:
        key = "frame_per" if arm.frame_per else "tool_per"
        raise InputError(
            f"{arm.name}: {key} asks for a frame per group of rows, which needs group columns; split the file"
        )
    weights = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
    rows = int((weights > 0).sum(-1).min())
    needed = 3 if arm.orientation == "rotation_vector" else 5
    if arm.unknown_frames and rows < needed:
        raise InputError(f"{arm.name}: its frames need at least {needed} training rows, got {rows}")
    values = arm.nominal.expand(*weights.shape[:-1], -1).clone()
    if not arm.unknown_frames:
        return values
    rotation, position, _, _ = arm.chain(joints)
    measured = arm.frame(pose)
    start = _start(rotation, position, measured, weights)
    free = _free(arm)
    frames = torch.cat([values[..., :6], values[..., -6:]], dim=-1)
    frames[..., free] = start[..., free]
    problem = _Problem(rotation, position, *measured, weights.sqrt(), rotation_weight, frames, free)
    found = levenberg_marquardt(problem.residual, frames[..., free], problem.jacobian, max_iterations=100, damping=1e-6)
    frames[..., free] = found.value
    values[..., :6], values[..., -6:] = frames[..., :6], frames[..., 6:]
    return values


def _free(arm: SerialArm) -> Tensor:
    """Which of the 12 frame parameters are fitted, as indices: base 0..5, tool 6..11."""
    base = range(6) if "base" in arm.unknown_frames else range(0)
    tool = range(6, 12 if arm.orientation == "rotation_vector" else 9) if "tool" in arm.unknown_frames else range(0)
    return torch.tensor([*base, *tool], dtype=torch.int64)


@dataclass(frozen=True)
class _Problem:
    """Weighted residuals of all rows over the 12 frame parameters, with their Jacobian in closed form.

    rotation `s x 3 x 3` and position `s x 3`: the flange in the base; measured_position `s x 3` and measured_rotation
    `s x 3 x 3` (or None); root_weights `... x s`; frames `... x 12`: start and what is not fitted; free: indices.
    """

    rotation: Tensor
    position: Tensor
    measured_position: Tensor
    measured_rotation: Tensor | None
    root_weights: Tensor
    rotation_weight: float
    frames: Tensor
    free: Tensor

    def _placed(self, free_values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Tool position `... x s x 3` and rotation, the flange's rotation in the record's frame, all 12 parameters."""
        frames = self.frames.clone()
        frames[..., self.free] = free_values
        base = rotation_vector_to_matrix(frames[..., 3:6])
        tool = rotation_vector_to_matrix(frames[..., 9:])
        flange = base[..., None, :, :] @ self.rotation
        arm = self.position @ base.mT + (flange @ frames[..., None, 6:9, None])[..., 0]
        return arm + frames[..., None, :3], flange @ tool[..., None, :, :], flange, frames

    def residual(self, free_values: Tensor) -> Tensor:
        position, rotation, _, _ = self._placed(free_values)
        rows = position - self.measured_position
        if self.measured_rotation is not None:
            turn = matrix_to_rotation_vector(rotation @ self.measured_rotation.mT)
            rows = torch.cat([rows, self.rotation_weight * turn], dim=-1)
        return (rows * self.root_weights[..., None]).flatten(-2)

    def jacobian(self, free_values: Tensor) -> Tensor:
        # The derivative of log(R Rmᵀ) is taken as the rate of rotation itself: the gradient is the same.
        position, _, flange, frames = self._placed(free_values)
        base_rate = _rotation_rate(frames[..., 3:6])[..., None, :, :]
        lever = position - frames[..., None, :3]
        eye = torch.eye(3, dtype=position.dtype).expand(*flange.shape)
        none = torch.zeros_like(flange)
        rows = torch.cat([eye, -skew(lever) @ base_rate, flange, none], dim=-1)
        if self.measured_rotation is not None:
            tool_rate = _rotation_rate(frames[..., 9:])[..., None, :, :]
            turning = torch.cat([none, base_rate.expand_as(none), none, flange @ tool_rate], dim=-1)
            rows = torch.cat([rows, self.rotation_weight * turning], dim=-2)
        rows = rows[..., self.free] * self.root_weights[..., None, None]
        return rows.flatten(-3, -2)


def _rotation_rate(vector: Tensor) -> Tensor:
    """Rate of rotation per change of the rotation vector, `... x 3 x 3`."""
    return frame_jacobian(lambda w: (w, rotation_vector_to_matrix(w)), vector)[..., 3:, :]


def _start(rotation: Tensor, position: Tensor, measured: Frame, weights: Tensor) -> Tensor:
    """Closed-form base and tool frame, `... x 12`; arguments as in `_Problem`, weights `... x s`."""
    if measured[1] is None:
        base = _base_by_relaxation(rotation, position, measured[0], weights)
        tool = torch.eye(3, dtype=base.dtype).expand_as(base)
    else:
        base, tool = _rotations_by_kronecker(rotation, measured[1], weights)
    # R_a t + u = R_bᵀ p_m - p_a is linear in the tool's position t and u = R_bᵀ t_b.
    right = measured[0] @ base - position
    eye = torch.eye(3, dtype=base.dtype).expand_as(rotation)
    solved = _weighted_linear(torch.cat([rotation, eye], dim=-1), right, weights)
    shift = (base @ solved[..., 3:, None])[..., 0]
    parts = [shift, matrix_to_rotation_vector(base), solved[..., :3], matrix_to_rotation_vector(tool)]
    return torch.cat(parts, dim=-1)


def _rotations_by_kronecker(rotation: Tensor, measured: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """R_b = R_m R_tᵀ R_aᵀ for all rows: the first singular pair of the mean of R_m ⊗ R_a (Shah 2013, eq. 28-31)."""
    products = torch.einsum("sij,slk->siljk", measured, rotation).reshape(len(rotation), 81)
    mean = (weights @ products / weights.sum(-1, keepdim=True)).reshape(*weights.shape[:-1], 9, 9)
    left, _, right = torch.linalg.svd(mean)
    base, tool = left[..., 0].reshape(*left.shape[:-2], 3, 3), right[..., 0, :].reshape(*left.shape[:-2], 3, 3)
    sign = torch.linalg.det(base).sign()[..., None, None]
    return roma.special_procrustes(base * sign), roma.special_procrustes(tool * sign).mT


def _base_by_relaxation(rotation: Tensor, position: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """R_bᵀ p_m - R_a t - u = p_a is linear once R_bᵀ may be any matrix; the nearest rotation to that matrix."""
    s = len(position)
    centred = measured - measured.mean(0)
    eye = torch.eye(3, dtype=position.dtype)
    matrix = torch.einsum("il,sj->silj", eye, centred).reshape(s, 3, 9)
    design = torch.cat([matrix, -rotation, -eye.expand(s, 3, 3)], dim=-1)
    solved = _weighted_linear(design, position, weights)
    relaxed = solved[..., :9].reshape(*solved.shape[:-1], 3, 3)
    base: Tensor = roma.special_procrustes(relaxed).mT
    return base


def _weighted_linear(design: Tensor, right: Tensor, weights: Tensor) -> Tensor:
    """Minimum-norm weighted least squares: design `s x 3 x m`, right `... x s x 3`, weights `... x s` -> `... x m`."""
    m = design.shape[-1]
    normal = (weights @ (design.mT @ design).reshape(-1, m * m)).reshape(*weights.shape[:-1], m, m)
    moment = ((weights[..., None, None] * right[..., None]) * design).sum((-3, -2))
    solved: Tensor = torch.linalg.pinv(normal, rtol=1e-12, hermitian=True) @ moment[..., None]
    return solved[..., 0]
