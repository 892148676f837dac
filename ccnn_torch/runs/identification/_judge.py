"""How good an identified geometry is: the pose it predicts, and the pose of the machine that is commanded by it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.least_squares import jacobian_of
from ccnn_torch.mechanisms import Mechanism, PoseError
from ccnn_torch.rotations import geodesic_angle
from ccnn_torch.runs.identification._measured import Measured

__all__ = ["Commanded", "commanded", "map_error", "noise_of_test", "predicted"]


class Commanded(NamedTuple):
    """Pose errors of the simulated machine at wanted poses: commanded by nominal geometry, exactly, and linearly."""

    before: PoseError
    exact: PoseError
    linear: PoseError


def predicted(measured: Measured, values: Tensor, machines: Tensor) -> PoseError:
    """Distance of the held-out measured poses from those that a geometry predicts from the joints, `r x t`.

    Args:
        values: `r x K` [SI].
        machines: which machines the rows are of, `r`.
    """
    rows = measured.test.of(machines)
    guess = rows.observed if measured.view is measured.mechanism else None
    if guess is None and measured.wanted is not None:
        guess = measured.wanted[machines]
    pose = measured.mechanism.forward_kinematics(rows.joints, values[:, None], guess)
    return _distance(measured.mechanism.frame(pose), measured.view.frame(rows.observed))


def noise_of_test(measured: Measured) -> PoseError | None:
    """Distance of the held-out measured poses from the true ones, `r x t`; None for records."""
    if measured.wanted is None:
        return None
    return _distance(measured.view.frame(measured.test.observed), measured.mechanism.frame(measured.wanted))


def commanded(measured: Measured, values: Tensor, machines: Tensor) -> Commanded | None:
    """Pose errors of the simulated machines at the wanted held-out poses, `r x t` each; None for records.

    Exact: the joints of the pose by the identified geometry. Linear: Sun et al. 2018, eq. 15, the nominal joints and
    the parameters' errors by the nominal identification Jacobian, dg/dθ (-J_p⁻¹ E_ac there).
    """
    if measured.wanted is None or measured.truth is None or measured.wanted_joints is None:
        return None
    return _commanded(
        measured.mechanism,
        measured.wanted[machines],
        measured.wanted_joints[machines],
        measured.start[machines],
        values,
        measured.truth[machines],
    )


def map_error(measured: Measured, values: Tensor, machines: Tensor) -> Tensor | None:
    """Position error at the points of the map, commanded by a geometry `r x K`; `r x m` [m]; None without a map."""
    if measured.map is None or measured.truth is None:
        return None
    mechanism, place = measured.mechanism, measured.map.expand(len(machines), -1, -1)
    joints = mechanism.solve_inverse(place, values[:, None], _near(mechanism, measured.map, len(machines)))
    reached = mechanism.forward_kinematics(joints, measured.truth[machines][:, None], place)
    return mechanism.pose_error(reached, place).position


def _commanded(
    mechanism: Mechanism, wanted: Tensor, guess: Tensor, nominal: Tensor, values: Tensor, truth: Tensor
) -> Commanded:
    near = mechanism.solve_inverse(wanted, nominal[:, None], guess)
    exact = mechanism.solve_inverse(wanted, values[:, None], near)

    def joints_of(parameters: Tensor) -> Tensor:
        return mechanism.solve_inverse(wanted, parameters, near)

    point = nominal[:, None].expand(*wanted.shape[:-1], -1)
    slope = jacobian_of(joints_of, point)[1]
    linear = near + (slope @ (values - nominal)[:, None, :, None])[..., 0]

    def error(joints: Tensor) -> PoseError:
        return mechanism.pose_error(mechanism.forward_kinematics(joints, truth[:, None], wanted), wanted)

    return Commanded(error(near), error(exact), error(linear))


def _near(mechanism: Mechanism, place: Tensor, machines: int) -> Tensor:
    joints = mechanism.solve_inverse(place)
    return joints.expand(machines, *joints.shape)


def _distance(first: tuple[Tensor, Tensor | None], second: tuple[Tensor, Tensor | None]) -> PoseError:
    position = torch.linalg.vector_norm(first[0] - second[0], dim=-1)
    if first[1] is None or second[1] is None:
        return PoseError(position, None)
    return PoseError(position, geodesic_angle(first[1], second[1]))


