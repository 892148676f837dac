"""Closed-form start of the fit of base and tool frame."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.mechanisms._pose import Frame
from ccnn_torch.rotations import matrix_to_rotation_vector, nearest_rotation

__all__ = ["closed_form_frames", "rigid_body_frame"]

# Share of the largest singular value by which a rotation that the points do not show stays near none at all.
_STILL = 1e-9


def closed_form_frames(rotation: Tensor, position: Tensor, measured: Frame, weights: Tensor) -> Tensor:
    """Base and tool frame that fit exact rows exactly and noisy ones nearly.

    With orientation by Shah's solution of A X = Z B (Shah 2013), a singular value decomposition; without by a linear
    relaxation of the base rotation (the tool's rotation is then the identity: positions do not show it).

    Args:
        rotation, position: the flange in the base, `... x s x 3 x 3` and `... x s x 3` [m].
        measured: position `... x s x 3` [m] and rotation `... x s x 3 x 3` (or None) in the record's frame.
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


def rigid_body_frame(here: Frame, there: Frame, weights: Tensor, rotation_weight: float) -> Tensor:
    """The rigid motion that takes some frames nearest to others (Kabsch 1976, with orientation beside the points).

    Points in one plane leave no choice of its normal: of the two motions that fit them up to a reflection, the proper
    rotation keeps their order in the plane. A rotation about points that stand in one line stays near none.

    Args:
        here, there: position `... x s x 3` [m] and rotation `... x s x 3 x 3`, or None.
        weights: `... x s` [1].
        rotation_weight: of orientation against position [m/rad].

    Returns:
        `... x 6`: position [m] and rotation vector [rad].
    """
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    middles = [(share * p).sum(-2, keepdim=True) for p in (here[0], there[0])]
    moment = ((there[0] - middles[1]) * share).mT @ (here[0] - middles[0])
    if here[1] is not None and there[1] is not None:
        moment = moment + rotation_weight**2 * (share[..., None] * (there[1] @ here[1].mT)).sum(-3)
    size = torch.linalg.matrix_norm(moment)[..., None, None].clamp_min(1e-30)
    turn = nearest_rotation(moment + _STILL * size * torch.eye(3, dtype=moment.dtype))
    shift = middles[1][..., 0, :] - (turn @ middles[0].mT)[..., 0]
    return torch.cat([shift, matrix_to_rotation_vector(turn)], dim=-1)


def _rotations_by_kronecker(rotation: Tensor, measured: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """R_b = R_m R_tᵀ R_aᵀ for all rows: the first singular pair of the mean of R_m ⊗ R_a (Shah 2013, eq. 28-31)."""
    products = torch.einsum("...ij,...lk->...iljk", measured, rotation).flatten(-4)
    mean = (weights[..., None, :] @ products)[..., 0, :] / weights.sum(-1, keepdim=True)
    mean = mean.reshape(*mean.shape[:-1], 9, 9)
    left, _, right = torch.linalg.svd(mean)
    base, tool = left[..., 0].reshape(*left.shape[:-2], 3, 3), right[..., 0, :].reshape(*left.shape[:-2], 3, 3)
    sign = torch.linalg.det(base).sign()[..., None, None]
    return nearest_rotation(base * sign), nearest_rotation(tool * sign).mT


def _base_by_relaxation(rotation: Tensor, position: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """R_bᵀ p_m - R_a t - u = p_a is linear once R_bᵀ may be any matrix; the nearest rotation to that matrix."""
    centred = measured - measured.mean(-2, keepdim=True)
    eye = torch.eye(3, dtype=position.dtype)
    matrix = torch.einsum("il,...j->...ilj", eye, centred).flatten(-2)
    design = torch.cat([matrix, -rotation, -eye.expand_as(rotation)], dim=-1)
    solved = _weighted_linear(design, position, weights)
    relaxed = solved[..., :9].reshape(*solved.shape[:-1], 3, 3)
    return nearest_rotation(relaxed).mT


def _weighted_linear(design: Tensor, right: Tensor, weights: Tensor) -> Tensor:
    """Minimum-norm weighted least squares, `... x m`.

    design `... x s x 3 x m`, right `... x s x 3`, weights `... x s`.
    """
    m = design.shape[-1]
    normal = (weights[..., None, :] @ (design.mT @ design).flatten(-2))[..., 0, :]
    normal = normal.reshape(*normal.shape[:-1], m, m)
    moment = ((weights[..., None, None] * right[..., None]) * design).sum((-3, -2))
    solved: Tensor = torch.linalg.pinv(normal, rtol=1e-12, hermitian=True) @ moment[..., None]
    return solved[..., 0]
