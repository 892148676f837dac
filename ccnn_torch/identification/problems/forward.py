"""Forward calibration: the measured pose against the one that the forward kinematics of the joints give."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.identification.problems.inverse import Noise
from ccnn_torch.identification.problems.parameters import ParameterChoice, select_parameters
from ccnn_torch.identification.problems.problem import Problem
from ccnn_torch.identification.problems.rows import check_finite, covariance, gather_rows
from ccnn_torch.identification.problems.whitened import Geometry, whitened_problem
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

_TURN = ("rx", "ry", "rz")


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
    rows = gather_rows(mechanism, joints, pose, weights, start)
    whole = (mechanism.nominal if start is None else start.detach()).reshape(-1, len(mechanism.nominal))
    selection = select_parameters(mechanism.geometry, choice, whole)
    names = [c.name for c in mechanism.pose]
    angles = torch.tensor([c.unit == "rad" for c in mechanism.pose], device=rows.pose.device)
    turning = [names.index(a) for a in _TURN] if set(_TURN) <= set(names) else []
    rest = [i for i in range(len(names)) if i not in turning]
    order = [*rest, *turning]
    geometry = Geometry(selection, rows.joints.shape[1])
    turns = (rotation_vector_to_matrix(rows.pose[..., turning]).flatten(-2),) if turning else ()

    def difference(full: Tensor, q: Tensor, x: Tensor, *measured: Tensor) -> Tensor:
        """In the order of `order`."""
        if isinstance(mechanism, SerialArm) and turning:
            position, rotation = mechanism.forward_frame(q, full)
        else:
            there = mechanism.forward_kinematics(q, full, x)
            if not turning:
                gap = there - x
                return torch.where(angles, gap - (gap.detach() / (2 * math.pi)).round() * (2 * math.pi), gap)
            position, rotation = there[..., rest], rotation_vector_to_matrix(there[..., turning])
        gap = position - x[..., rest]
        back = measured[0].reshape(*measured[0].shape[:-1], 3, 3).mT
        return torch.cat([gap, matrix_to_rotation_vector(rotation @ back)], dim=-1)

    def gap(values: Tensor, q: Tensor, x: Tensor, *more: Tensor) -> Tensor:
        return difference(geometry(values, *more[len(turns) :]), q, x, *more[: len(turns)])

    data = (rows.joints, rows.pose, *turns, *geometry.data)
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
    )
