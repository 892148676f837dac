"""Predicted deviations of a trained method, and the pose error before and after."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.calibration.learning.fitting import Fitted
from ccnn_torch.calibration.rows.prepare import Prepared
from ccnn_torch.mechanisms import PoseError

# The fixed point q = q* - δ(q) gains a factor of the Lipschitz constant of δ each time, about 1e-3 for real machines.
_COMMAND_ITERATIONS = 8


@dataclass(frozen=True)
class Outcome:
    """A method's figures on every row of every repeat; which rows are held out is for the reader to choose.

    Attributes:
        deviation: predicted deviation at the commanded joints, `r x s x n` [SI]; of what identified geometry and known
            effects leave where these are a part of the compensator.
        after: pose error with the correction, `r x s`.
        after_systematic: the same without the machine's noise, where it is simulated.
    """

    fitted: Fitted
    deviation: Tensor
    after: PoseError
    after_systematic: PoseError | None = None


def pose_before(prepared: Prepared) -> PoseError:
    """Pose error without compensation, `r x s`.

    Simulated: the pose reached under the ideal joints against the ideal pose. Recorded: the pose measured against the
    nominal machine's, fitted frames included.
    """
    if prepared.simulation is not None:
        return prepared.simulation.pose_errors(prepared.joints)[0]
    nominal = prepared.mechanism.forward_kinematics(prepared.joints, prepared.parameters)
    return prepared.mechanism.pose_error(prepared.pose, nominal)


def pose_with_geometry(prepared: Prepared) -> PoseError | None:
    """Pose error that geometric calibration alone leaves, `r x s`; None where no geometry was fitted."""
    if prepared.identified is None:
        return None
    reached = prepared.mechanism.forward_kinematics(prepared.joints, prepared.identified)
    return prepared.mechanism.pose_error(prepared.pose, reached)


def evaluate(prepared: Prepared, fitted: Fitted) -> Outcome:
    """Predict on every row, and find the pose error that is left.

    Simulated: the machine is commanded q with q + δ(q) = q*, and the pose that it then reaches is solved.
    Recorded: FK(q + δ(q)) predicts the measured pose, δ with identified geometry and known effects where there are.
    """
    joints = prepared.joints
    deviation = _deviation(prepared, fitted, joints)
    if prepared.simulation is None:
        return Outcome(fitted, deviation, _pose_left(prepared, deviation))
    command = joints
    for _ in range(_COMMAND_ITERATIONS):
        command = joints - _deviation(prepared, fitted, command)
    return Outcome(fitted, deviation, *prepared.simulation.pose_errors(command))


def pose_with_effects(prepared: Prepared) -> PoseError | None:
    """Pose error that known effects leave by themselves, with the geometry beside them, `r x s`; None without them."""
    return None if prepared.effects is None else _pose_left(prepared, torch.zeros_like(prepared.joints))


def _pose_left(prepared: Prepared, deviation: Tensor) -> PoseError:
    """Between measured poses and those predicted with the learned part of the deviation, `r x s x n` [SI]."""
    joints, total = prepared.joints, deviation
    if prepared.effects is not None:
        total = total + prepared.effects.deviation(joints + total)
    if prepared.geometry is not None:
        total = total + prepared.geometry.deviation(prepared.pose)(joints + total)
    reached = prepared.mechanism.forward_kinematics(joints + total, prepared.parameters)
    return prepared.mechanism.pose_error(prepared.pose, reached)


def _deviation(prepared: Prepared, fitted: Fitted, joints: Tensor) -> Tensor:
    return fitted.predict(torch.cat([joints, prepared.covariates], -1))
