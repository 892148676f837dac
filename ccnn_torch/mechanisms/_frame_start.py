"""Closed-form start of the fit of base and tool frame."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.mechanisms._pose import Frame
from ccnn_torch.rotations import matrix_to_rotation_vector, nearest_rotation

__all__ = ["closed_form_frames"]


def closed_form_frames(rotation: Tensor, position: Tensor, measured: Frame, weights: Tensor) -> Tensor:
    """Base and tool frame that fit exact rows exactly and noisy ones nearly.

    With orientation by Shah's solution of A X = Z B (Shah 2013), a singular value decomposition; without by a linear
    relaxation of the base rotation (the tool's rotation is then the identity: positions do not show it).

    Args:
        rotation, position: the flange in the base, `s x 3 x 3` and `s x 3` [m].
        measured: position `s x 3` [m] and rotation `s x 3 x 3` (or None) in the record's frame.
        weights: `... x s` [1].

    Returns:
        `... x 12`: base, then tool, each position [m] and rotation vector [rad].
    """
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
    return nearest_rotation(base * sign), nearest_rotation(tool * sign).mT


def _base_by_relaxation(rotation: Tensor, position: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """R_bᵀ p_m - R_a t - u = p_a is linear once R_bᵀ may be any matrix; the nearest rotation to that matrix."""
    s = len(position)
    centred = measured - measured.mean(0)
    eye = torch.eye(3, dtype=position.dtype)
    matrix = torch.einsum("il,sj->silj", eye, centred).reshape(s, 3, 9)
    design = torch.cat([matrix, -rotation, -eye.expand(s, 3, 3)], dim=-1)
    solved = _weighted_linear(design, position, weights)
    relaxed = solved[..., :9].reshape(*solved.shape[:-1], 3, 3)
    return nearest_rotation(relaxed).mT


def _weighted_linear(design: Tensor, right: Tensor, weights: Tensor) -> Tensor:
    """Minimum-norm weighted least squares: design `s x 3 x m`, right `... x s x 3`, weights `... x s` -> `... x m`."""
    m = design.shape[-1]
    normal = (weights @ (design.mT @ design).reshape(-1, m * m)).reshape(*weights.shape[:-1], m, m)
    moment = ((weights[..., None, None] * right[..., None]) * design).sum((-3, -2))
    solved: Tensor = torch.linalg.pinv(normal, rtol=1e-12, hermitian=True) @ moment[..., None]
    return solved[..., 0]
