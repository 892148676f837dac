"""Inverse calibration: measured joints against those that the inverse kinematics of the measured pose gives.

Zhuang, Yan and Masory (1998); papers: Zhang and Gao 2012 eq. 1 (pseudoerror), the divide-and-conquer paper's eq. 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification._rows import MeasuredRows, check_finite, covariance, gather_rows, inverse_root
from ccnn_torch.identification.checks import check_equations
from ccnn_torch.identification.parameters import ParameterChoice, Selection, select_parameters
from ccnn_torch.identification.problem import Channel, Problem
from ccnn_torch.least_squares import jacobian_of
from ccnn_torch.mechanisms import Mechanism

__all__ = ["inverse_problem"]

Noise = float | Sequence[float] | Tensor
_DEPENDS = 1e-9  # Relative size of a derivative below which it is rounding.


def inverse_problem(
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    weights: Tensor | None = None,
    choice: ParameterChoice | None = None,
    pose_noise: Noise | None = None,
    joint_noise: Noise | None = None,
    start: Tensor | None = None,
    per_leg: bool = False,
) -> Problem:
    """Residual g(X; theta) - q of the inverse kinematics g at the measured poses, divided by its noise.

    The noise of a residual row is that of the joints and that of the pose, carried over by dg/dX at the starting
    geometry. The rows are decorrelated by its Cholesky factor, so that least squares weighs every direction of the
    pose as it was measured; with `per_leg` each joint is only divided by its own standard deviation, so that the legs
    stay apart (`split_by_leg`), and joints that no free parameter moves are left out. Without any noise given, the
    residual is in joint units and its variance is estimated from the fit.

    Args:
        mechanism: any with an inverse; where that is iterative, it starts from the measured joints.
        joints: `s x n` or `r x s x n`, as commanded or read [SI].
        pose: `s x p` or `r x s x p`, measured [SI].
        weights: `s` or `r x s` [1]; 0 leaves a row out; all 1 when None.
        choice: what is free, fixed, tied, held by a prior; everything free when None.
        pose_noise: standard deviation of each pose coordinate, one for all or `p` of them [SI], or the covariance,
            `p x p` or `r x s x p x p`.
        joint_noise: likewise of the joints.
        start: the whole geometry from which the search begins, `K` or `r x K` [SI]; nominal when None.
        per_leg: keep the channels of different legs apart.

    Raises:
        InputError: a pose out of reach (the row and the joint are named), columns or noise of another shape, a noise
            that is singular, fewer equations than parameters, or a choice that does not fit the mechanism.
    """
    rows = gather_rows(mechanism, joints, pose, weights, start)
    selection = select_parameters(mechanism.geometry, choice, mechanism.nominal if start is None else start)
    used = rows.weights > 0
    names = [j.name for j in mechanism.joints]
    turn = 2 * math.pi * torch.tensor([j.unit == "rad" for j in mechanism.joints], dtype=torch.float64)
    spread, fixed = selection.spread, selection.fixed
    everything = bool((spread.shape[0] == spread.shape[1]) and (spread == torch.eye(len(spread))).all())
    apart = len(fixed) > 1 and bool((fixed != fixed[:1]).any())

    def gap(values: Tensor, x: Tensor, q: Tensor, *rest: Tensor) -> Tensor:
        full = values if everything else values @ spread + (rest[0] if rest else fixed[0])
        difference = mechanism.solve_inverse(x, full, q) - q
        return difference - (difference.detach() / (2 * math.pi)).round() * turn

    begin = selection.start.expand(rows.machines, -1)
    extra = (fixed[:, None].expand(-1, rows.pose.shape[1], -1),) if apart else ()
    first = gap(begin[:, None], rows.pose, rows.joints, *extra)
    check_finite(first, used, rows.pose, mechanism, [f"joint {n}" for n in names])

    n = len(names)
    whole = selection.full(selection.start)[:, None]
    matrix = _joint_covariance(mechanism, rows.joints, rows.pose, whole, pose_noise, joint_noise)
    moved = _depends(lambda v: gap(v, *(d[:1] for d in (rows.pose, rows.joints, *extra))), begin[:1], rows, selection)
    kept = [i for i in range(n) if bool(moved[i].any())] if per_leg else list(range(n))
    if not kept:
        free = ", ".join(p.name for p in selection.parameters)
        raise InputError(f"parameters.free: no joint of mechanism '{mechanism.name}' depends on {free}; free others")
    diagonal = matrix is None or per_leg or bool((matrix == _only_diagonal(matrix)).all())
    whiten: tuple[Tensor, ...] = ()
    if matrix is not None:
        root = _shared(inverse_root(_only_diagonal(matrix) if diagonal else matrix, used, "joints"))
        whiten = (root.diagonal(dim1=-2, dim2=-1)[..., kept] if diagonal else root.flatten(-2),)

    def residual(values: Tensor, x: Tensor, q: Tensor, *rest: Tensor) -> Tensor:
        difference = gap(values, x, q, *rest[len(whiten) :])
        if not diagonal:
            return (rest[0].reshape(*rest[0].shape[:-1], n, n) * difference[..., None, :]).sum(-1)
        if len(kept) < n:
            difference = difference[..., kept]
        return difference * rest[0] if whiten else difference

    problem = Problem(
        parameters=selection.parameters,
        start=begin,
        scale=selection.scale,
        prior_sd=selection.prior_sd,
        residual=residual,
        data=(rows.pose, rows.joints, *whiten, *extra),
        weights=rows.weights,
        channels=tuple(Channel(names[i], _leg(selection.parameters, moved[i]) if diagonal else None) for i in kept),
        noise_known=matrix is not None,
    )
    check_equations(problem)
    return problem


def _joint_covariance(
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    parameters: Tensor,
    pose_noise: Noise | None,
    joint_noise: Noise | None,
) -> Tensor | None:
    """Noise of g(X) - q to first order, `r x s x n x n`; None where nothing is known."""
    of_pose = covariance(pose_noise, mechanism.pose, "pose_noise")
    of_joints = covariance(joint_noise, mechanism.joints, "joint_noise")
    total: Tensor | None = None
    if of_pose is not None:
        machines = max(len(pose), len(joints), len(parameters))
        slope = jacobian_of(lambda x: mechanism.solve_inverse(x, parameters, joints), pose.expand(machines, -1, -1))[1]
        total = slope @ of_pose @ slope.mT
    if of_joints is not None:
        total = of_joints.expand(1, pose.shape[1], -1, -1) if total is None else total + of_joints
    return total


def _only_diagonal(matrix: Tensor) -> Tensor:
    return torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1))


def _depends(gap: Callable[[Tensor], Tensor], start: Tensor, rows: MeasuredRows, selection: Selection) -> Tensor:
    """Which joints depend on which free parameters, in the first machine's rows: `n x k`, bool."""
    slope = jacobian_of(gap, start[:, None].expand(-1, rows.pose.shape[1], -1))[1]
    size = (torch.nan_to_num(slope).abs() * selection.scale).flatten(0, 1).amax(0)
    return size > _DEPENDS * size.max()


def _leg(parameters: Sequence[Parameter], moved: Tensor) -> int | None:
    legs = {p.leg for p, m in zip(parameters, moved.tolist(), strict=True) if m}
    return legs.pop() if len(legs) == 1 else None


def _shared(table: Tensor) -> Tensor:
    """One copy where all machines have the same."""
    return table[:1] if len(table) > 1 and bool((table == table[:1]).all()) else table
