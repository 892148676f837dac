"""Pose error of an identified geometry: predicted, and under commands computed with it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ccnn_torch.identification.measured.measured import Measured
from ccnn_torch.mechanisms import PoseError
from ccnn_torch.numerics.least_squares import jacobian_of


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
    pose = measured.kinematics.reached(rows.joints, values[:, None], rows.observed)
    return measured.mechanism.pose_error(pose, rows.observed)


def noise_of_test(measured: Measured) -> PoseError | None:
    """Distance of the held-out measured poses from the true ones, `r x t`; None for records."""
    if measured.reached is None:
        return None
    return measured.mechanism.pose_error(measured.test.observed, measured.reached)


def commanded(measured: Measured, values: Tensor, machines: Tensor) -> Commanded | None:
    """Pose errors of the simulated machines at the wanted held-out poses, `r x t` each; None for records.

    Exact: the joints of the pose by the identified geometry. Linear: Sun et al. 2018, eq. 15, the nominal joints and
    the parameters' errors by the nominal identification Jacobian dg/dθ (-J_p⁻¹ E_ac there).
    """
    if measured.wanted is None or measured.truth is None or measured.wanted_joints is None:
        return None
    wanted, guess, truth = (t[machines] for t in (measured.wanted, measured.wanted_joints, measured.truth))
    nominal, mechanism = measured.start[machines], measured.mechanism
    near = mechanism.solve_inverse(wanted, nominal[:, None], guess)
    exact = measured.kinematics.command(wanted, values[:, None], near)

    def joints_of(parameters: Tensor) -> Tensor:
        return mechanism.solve_inverse(wanted, parameters, near)

    slope = jacobian_of(joints_of, nominal[:, None].expand(*wanted.shape[:-1], -1))[1]
    linear = near + (slope @ (values - nominal)[:, None, :, None])[..., 0]

    def error(joints: Tensor) -> PoseError:
        return mechanism.pose_error(measured.kinematics.reached(joints, truth[:, None], wanted), wanted)

    return Commanded(error(near), error(exact), error(linear))


def map_error(measured: Measured, values: Tensor, machines: Tensor) -> Tensor | None:
    """RMS over the machines of the position error at the points of the map, commanded by a geometry; `m` [m].

    Args:
        values: `r x K` [SI].
    """
    if measured.map is None or measured.truth is None:
        return None
    mechanism, place = measured.mechanism, measured.map.expand(len(machines), -1, -1)
    guess = mechanism.solve_inverse(measured.map).expand(len(machines), -1, -1)
    joints = measured.kinematics.command(place, values[:, None], guess)
    reached = measured.kinematics.reached(joints, measured.truth[machines][:, None], place)
    # At the very edge a machine may not reach what the nominal one does: its NaN is no error of a position.
    return mechanism.pose_error(reached, place).position.square().nanmean(0).sqrt()
