"""Measured poses as equations: against joints (inverse calibration) or against computed poses (forward calibration).

Inverse calibration: Zhuang, Yan and Masory (1998); eq. 5 of the divide-and-conquer paper. The difference is the
pseudoerror of eq. 1 of Zhang and Gao (2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.identification.problems.parameters import ParameterChoice, Selection, select_parameters
from ccnn_torch.identification.problems.problem import Problem
from ccnn_torch.identification.problems.whitened import (
    Geometry,
    MeasuredRows,
    check_finite,
    covariance,
    gather_rows,
    whitened_problem,
)
from ccnn_torch.mechanisms import Giving, Mechanism, Seen, SerialArm, SetUps
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

Noise = float | Sequence[float] | Tensor
"""Standard deviation, one for all coordinates or one each [SI]; or their covariance."""


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

    Where the geometry found is far from the start, build the problem again with `start` there: the noise is then
    carried over by the right geometry.

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
            that is singular, a prior without noise, fewer equations than parameters, or a choice that does not fit the
            mechanism.
    """
    rows, whole, selection, geometry = _begun(mechanism, joints, pose, weights, choice, start)
    names = [j.name for j in mechanism.joints]
    turn = 2 * math.pi * torch.tensor([j.unit == "rad" for j in mechanism.joints], dtype=torch.float64)
    turn = turn.to(rows.joints.device)

    def gap(values: Tensor, x: Tensor, q: Tensor, *fixed: Tensor) -> Tensor:
        difference = mechanism.solve_inverse(x, geometry(values, *fixed), q) - q
        return difference - (difference.detach() / (2 * math.pi)).round() * turn

    data = (rows.pose, rows.joints, *geometry.data)
    used = rows.weights > 0
    first = gap(selection.start[:, None], *data)
    check_finite(first, used, rows.pose, mechanism.pose, mechanism.name, [f"joint {n}" for n in names])

    of_pose = covariance(pose_noise, mechanism.pose, "pose_noise")
    total = covariance(joint_noise, mechanism.joints, "joint_noise")
    if of_pose is not None:
        point = rows.pose.expand(len(first), -1, -1)
        slope = jacobian_of(lambda x: mechanism.solve_inverse(x, whole[:, None], rows.joints), point)[1]
        carried = slope @ of_pose @ slope.mT
        total = carried if total is None else carried + total
    return whitened_problem(
        gap,
        data,
        total,
        rows,
        selection,
        names,
        f"joint of mechanism '{mechanism.name}'",
        total is not None,
        per_leg,
    )


_TURN = ("rx", "ry", "rz")


def _begun(
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    weights: Tensor | None,
    choice: ParameterChoice | None,
    start: Tensor | None,
) -> tuple[MeasuredRows, Tensor, Selection, Geometry]:
    """Rows, geometry at the start `r x K` [SI], the free parameters, and the way from them to the geometry."""
    rows = gather_rows(mechanism, joints, pose, weights, start)
    whole = (mechanism.nominal if start is None else start.detach()).reshape(-1, len(mechanism.nominal))
    selection = select_parameters(mechanism.geometry, choice, whole)
    return rows, whole, selection, Geometry(selection, rows.joints.shape[1])


def compares_poses(mechanism: Mechanism) -> bool:
    """Whether measured poses are compared with computed ones, since the joints of a pose are a search or not unique.

    So of serial arms, of poses in a frame of their own (base_x …), which a leg alone lacks, and of a machine that has
    more joints than pose coordinates and computes its pose from them.
    """
    if (
        mechanism.orientations
        or isinstance(mechanism, Seen)
        or any(p.name.startswith(("base_", "tool_")) for p in mechanism.geometry)
    ):
        return True
    computed = type(mechanism).forward_kinematics is not Mechanism.forward_kinematics
    return computed and len(mechanism.joints) > len(mechanism.pose)


def _plain(mechanism: Mechanism) -> Mechanism:
    """The machine itself, without set-ups and given numbers around it."""
    while isinstance(mechanism, SetUps | Giving):
        mechanism = mechanism.machine
    return mechanism


def forward_problem(
    mechanism: Mechanism,
    joints: Tensor,
    pose: Tensor,
    weights: Tensor | None = None,
    choice: ParameterChoice | None = None,
    pose_noise: Noise | None = None,
    joint_noise: Noise | None = None,
    start: Tensor | None = None,
    rotation_weight: float = 0.3,
) -> Problem:
    """Residual f(q; theta) - X of the forward kinematics f, divided by its noise.

    Coordinates rx, ry, rz count as the rotation vector from the measured orientation to the computed one, in the
    measuring frame; other angles as their difference within half a turn. Noise of the joints is carried over by df/dq
    at the starting geometry. Without any noise given, angles are multiplied by `rotation_weight` and the variance is
    estimated from the fit.

    A coordinate that was not measured in a row (NaN) is no equation there; of rx, ry, rz all three are lacking then.

    Args:
        mechanism: serial arms, and whatever has its forward kinematics exactly; iterative ones start from the
            measured pose.
        joints, pose, weights, choice, joint_noise, start: as `inverse_problem`; a joint noise matters only beside a
            pose noise.
        pose_noise: likewise; that of rx, ry, rz is about the axes of the measuring frame.
        rotation_weight: [m/rad].

    Raises:
        InputError: as `inverse_problem`.
    """
    known = ~pose.isnan()
    # What is not measured is filled in, so that all is finite, and left out of the residual.
    about = None if start is None else start[..., None, :]
    pose = completed(mechanism, joints, pose, about)
    rows, whole, selection, geometry = _begun(mechanism, joints, pose, weights, choice, start)
    names = [c.name for c in mechanism.pose]
    angles = torch.tensor([c.unit == "rad" for c in mechanism.pose], device=rows.pose.device)
    turning = [names.index(a) for a in _TURN] if set(_TURN) <= set(names) else []
    rest = [i for i in range(mechanism.compared) if i not in turning]
    order = [*rest, *turning]
    turns = (rotation_vector_to_matrix(rows.pose[..., turning]).flatten(-2),) if turning else ()
    seen = None if bool(known.all()) else known[..., order].reshape(-1, rows.pose.shape[-2], len(order))

    plain = _plain(mechanism)

    def difference(full: Tensor, q: Tensor, x: Tensor, *measured: Tensor) -> Tensor:
        """In the order of `order`."""
        if isinstance(plain, SerialArm) and turning:
            assert isinstance(mechanism, SerialArm | SetUps | Giving)
            position, rotation = mechanism.forward_frame(q, full)
        else:
            there = mechanism.forward_kinematics(q, full, x)
            if not turning:
                gap = (there - x)[..., rest]
                return torch.where(angles[rest], gap - (gap.detach() / (2 * math.pi)).round() * (2 * math.pi), gap)
            position, rotation = there[..., rest], rotation_vector_to_matrix(there[..., turning])
        gap = position - x[..., rest]
        back = measured[0].reshape(*measured[0].shape[:-1], 3, 3).mT
        return torch.cat([gap, matrix_to_rotation_vector(rotation @ back)], dim=-1)

    def gap(values: Tensor, q: Tensor, x: Tensor, *more: Tensor) -> Tensor:
        found = difference(geometry(values, *more[len(turns) + len(shown) :]), q, x, *more[: len(turns)])
        return torch.where(more[len(turns)] > 0, found, 0.0) if shown else found

    shown = () if seen is None else (seen.to(torch.float64),)
    data = (rows.joints, rows.pose, *turns, *shown, *geometry.data)
    first = gap(selection.start[:, None], *data)
    check_finite(first, rows.weights > 0, rows.joints, mechanism.joints, mechanism.name, [names[i] for i in order])

    total = covariance(pose_noise, mechanism.pose, "pose_noise")
    if total is None:
        weight = torch.where(angles, 1 / rotation_weight, 1.0).to(torch.float64)
        total = torch.diag(weight.square())
    total = total[..., order, :][..., order]
    of_joints = covariance(joint_noise, mechanism.joints, "joint_noise") if pose_noise is not None else None
    if of_joints is not None:
        point = rows.joints.expand(len(first), -1, -1)
        slope = jacobian_of(lambda q: difference(whole[:, None], q, rows.pose, *turns), point)[1]
        total = total + slope @ of_joints @ slope.mT
    return whitened_problem(
        gap,
        data,
        total,
        rows,
        selection,
        [names[i] for i in order],
        f"pose coordinate of mechanism '{mechanism.name}'",
        pose_noise is not None,
        seen=seen,
    )
