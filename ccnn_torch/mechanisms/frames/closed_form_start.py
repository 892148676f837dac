"""Closed-form start of the fit of base and tool frame."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.mechanisms.pose import Frame
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, nearest_rotation, rotation_vector_to_matrix

# Share of the largest singular value by which a rotation that the points do not show stays near none at all.
_STILL = 1e-9
# Of the squared lengths that rows of one metre have: what they show by less than 3 µm stays near zero.
_RIDGE = 1e-11


def closed_form_frames(rotation: Tensor, position: Tensor, measured: Frame, tool: Tensor, weights: Tensor) -> Tensor:
    """Base and tool frames near those that fit the rows, from three closed forms; which one is best the rows decide.

    1. Orientation: Shah's solution of A X = Z B (Shah 2013), a singular value decomposition. It is the best where the
       orientation varies about two axes, and means nothing where it does not. Without orientation as 2.
    2. Positions: a linear relaxation of the base rotation. It wants positions in all three dimensions.
    3. Both: the rigid motion (Kabsch 1976) that takes the points of the nominal tool to the measured ones. It holds
       with one orientation and with points in a plane; on a line the turn about it is left as it is.

    Args:
        rotation, position: the flange in the base, `... x s x 3 x 3` and `... x s x 3` [m].
        measured: position `... x s x 3` [m] and rotation `... x s x 3 x 3` (or None) in the record's frame.
        tool: nominal, `6`: position [m] and rotation vector [rad].
        weights: `... x s` [1].

    Returns:
        `3 x ... x 12`: base, then tool, each position [m] and rotation vector [rad].
    """
    points = position + (rotation @ tool[:3, None])[..., 0]
    by_points = rigid_body_frame((points, None), (measured[0], None), weights, 0.0)
    by_relaxation = _base_by_relaxation(rotation, position, measured[0], weights)
    bases = [by_relaxation, by_relaxation, rotation_vector_to_matrix(by_points[..., 3:])]
    if measured[1] is None:
        turn = rotation_vector_to_matrix(tool[3:])
        tools = [turn.expand_as(base) for base in bases]
    else:
        share = (weights / weights.sum(-1, keepdim=True))[..., None, None]
        shah = _rotations_by_kronecker(rotation, measured[1], weights)
        bases[0] = shah[0]
        there = [rotation.mT @ base.mT[..., None, :, :] @ measured[1] for base in bases[1:]]
        tools = [shah[1], *(nearest_rotation((share * turned).sum(-3)) for turned in there)]
    found = [
        _placed(base, turn, rotation, position, measured[0], weights) for base, turn in zip(bases, tools, strict=True)
    ]
    return torch.stack(found)


def best_closed_form(
    rotation: Tensor, position: Tensor, measured: Frame, tool: Tensor, weights: Tensor, rotation_weight: float
) -> Tensor:
    """The one of `closed_form_frames` that misses the rows least, `... x 12`; rotation_weight [m/rad]."""
    found = closed_form_frames(rotation, position, measured, tool, weights)
    base, turn = (rotation_vector_to_matrix(found[..., None, k : k + 3]) for k in (3, 9))
    lever = position + (rotation @ found[..., None, 6:9, None])[..., 0]
    miss = (base @ lever[..., None])[..., 0] + found[..., None, :3] - measured[0]
    square = miss.square().sum(-1)
    if measured[1] is not None:
        angle = matrix_to_rotation_vector(base @ rotation @ turn @ measured[1].mT)
        square = square + rotation_weight**2 * angle.square().sum(-1)
    best = (weights * square).sum(-1).argmin(0)
    return found.gather(0, best[None, ..., None].expand(1, *found.shape[1:]))[0]


def _placed(
    base: Tensor, tool: Tensor, rotation: Tensor, position: Tensor, measured: Tensor, weights: Tensor
) -> Tensor:
    """Both frames of two rotations `... x 3 x 3`: R_a t + u = R_bᵀ p_m - p_a is linear in the tool's t and R_bᵀ t_b."""
    right = measured @ base - position
    eye = torch.eye(3, dtype=base.dtype).expand_as(rotation)
    solved = _weighted_linear(torch.cat([rotation, eye], dim=-1), right, weights)
    shift = (base @ solved[..., 3:, None])[..., 0]
    parts = [shift, matrix_to_rotation_vector(base), solved[..., :3], matrix_to_rotation_vector(tool)]
    return torch.cat(parts, dim=-1)


def rigid_body_frame(here: Frame, there: Frame, weights: Tensor, rotation_weight: float) -> Tensor:
    """The rigid motion that takes some frames nearest to others (Kabsch 1976, with orientation beside the points).

    Points in one plane leave no choice of its normal: of the two motions that fit them up to a reflection, the proper
    rotation keeps their order in the plane. A rotation about collinear points stays near zero.

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
    """Weighted least squares, `... x m`, what the rows hardly show near zero; the last three columns are a shift.

    design `... x s x 3 x m`, right `... x s x 3`, weights `... x s`.
    """
    m = design.shape[-1]
    normal = (weights[..., None, :] @ (design.mT @ design).flatten(-2))[..., 0, :]
    normal = normal.reshape(*normal.shape[:-1], m, m)
    moment = ((weights[..., None, None] * right[..., None]) * design).sum((-3, -2))
    ridge = torch.full((m,), _RIDGE, dtype=design.dtype)
    ridge[-3:] = 0
    solved: Tensor = torch.linalg.solve(
        normal + torch.diag_embed(ridge * weights.sum(-1, keepdim=True)), moment[..., None]
    )
    return solved[..., 0]
