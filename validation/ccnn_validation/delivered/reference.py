"""The reference: a least-squares fit that knows the form of every error, its Cramér-Rao bound, and its commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ccnn_validation.delivered.machine import Machine, Pose
from ccnn_validation.delivered.plan import Rows
from ccnn_validation.delivered.rotation import Array, difference

ROTATION_WEIGHT = 0.3
"""Weight of orientation against position [m/rad], in frames and commands."""
_STEP = 1e-4
"""Step of a derivative, in standard deviations of the prior, and never more than 1e-6 m or rad."""
_OPEN = 1e-2
"""Weight of a frame that the rows leave open, beside errors in m."""
_NEWTON = 12
_DAMPING = 2e-3


@dataclass(frozen=True)
class Fit:
    """Unknowns `k` as fitted, and the slopes of whitened rows by unknowns in units of the prior, `rows x k`."""

    unknowns: Array
    slopes: Array


def apart(first: Pose, second: Pose, position: float = 1.0, rotation: float = ROTATION_WEIGHT) -> Array:
    """Second less first pose, `s x d`: the position over `position` [m], then the turn times `rotation`."""
    parts = [(second.position - first.position) / position]
    if first.rotation is not None and second.rotation is not None:
        parts.append(difference(first.rotation, second.rotation) * rotation)
    return np.concatenate(parts, -1)


def rms(first: Pose, second: Pose, span: Array | None = None) -> tuple[float, float]:
    """RMS distance [m] and angle [rad] of poses (0 without orientation); with a span, of what lies in it."""
    errors = apart(first, second)
    if span is not None:
        errors = (span @ errors[..., None])[..., 0]
    split = first.position.shape[1]
    position, rotation = (float(np.sqrt((part**2).sum(-1).mean())) for part in np.split(errors, [split], -1))
    return position, rotation / ROTATION_WEIGHT


def reachable(machine: Machine, frames: Array, joints: Array) -> Array | None:
    """Projections of errors (as of `apart`) onto what the joints can change, `s x d x d`; None where that is all."""
    if machine.nominal_pose(frames, joints[:1]).rotation is None or joints.shape[1] >= 6:
        return None
    base, _ = np.linalg.qr(joint_slopes(lambda at: machine.nominal_pose(frames, at), joints))
    return np.asarray(base @ base.swapaxes(1, 2))


def joint_slopes(pose: Callable[[Array], Pose], joints: Array) -> Array:
    """Derivative of a pose (as of `apart`) by the joints, `s x d x n`."""
    columns = []
    for i in range(joints.shape[1]):
        change = np.zeros(joints.shape[1])
        change[i] = 1e-6
        columns.append(apart(pose(joints - change), pose(joints + change)) / 2e-6)
    return np.stack(columns, -1)


def slopes(function: Callable[[Array], Array], at: Array, step: Array) -> Array:
    """Central differences of a function of `k` numbers, `... x k`."""
    columns = []
    for i in range(len(at)):
        change = np.zeros(len(at))
        change[i] = step[i]
        columns.append((function(at + change) - function(at - change)) / (2 * step[i]))
    return np.stack(columns, -1)


def fitted(machine: Machine, rows: Rows, measured: Pose) -> Fit:
    """All unknowns by least squares from measured poses, each drawn to its centre by its prior."""
    centre, prior = machine.vector("centre"), machine.vector("prior")
    position, rotation = machine.noise

    def misfit(scaled: Array) -> Array:
        model = machine.pose(centre + prior * scaled, rows.joints, rows.covariates)
        return np.concatenate([apart(model, measured, position, 1 / rotation).ravel(), scaled])

    step = _steps(prior)

    def jacobian(scaled: Array) -> Array:
        return slopes(misfit, scaled, step)

    found = least_squares(misfit, np.zeros(len(centre)), jac=jacobian, method="trf", ftol=1e-6)
    return Fit(centre + prior * found.x, jacobian(found.x)[: -len(centre)])


def _steps(prior: Array) -> Array:
    """Steps in units of the prior: 1e-6 m or rad for wide priors, a ten-thousandth of narrow ones."""
    return np.asarray(np.minimum(_STEP, 1e-6 / prior))


def expected(machine: Machine, fit: Fit, rows: Rows, share: float = 1.0) -> tuple[float, float]:
    """RMS error of the fitted model by the Cramér-Rao bound, position [m] and orientation [rad].

    Args:
        machine, fit: as fitted.
        rows: where the model is asked.
        share: share of the measured rows that are fitted (the information of the rows, not of the prior, is less).
    """
    prior, one = machine.vector("prior"), np.eye(len(fit.unknowns))
    _, upper = np.linalg.qr(np.concatenate([np.sqrt(share) * fit.slopes, one]))
    model = machine.pose(fit.unknowns, rows.joints, rows.covariates)

    def moved(unknowns: Array) -> Array:
        return apart(model, machine.pose(unknowns, rows.joints, rows.covariates), 1.0, 1.0)

    slope = slopes(moved, fit.unknowns, _steps(prior) * prior) * prior
    variance = (np.linalg.solve(upper.T, slope.reshape(-1, len(prior)).T) ** 2).sum(0).reshape(slope.shape[:-1])
    split = model.position.shape[1]
    return float(np.sqrt(variance[:, :split].sum(-1).mean())), float(np.sqrt(variance[:, split:].sum(-1).mean()))


def fitted_frames(machine: Machine, joints: Array, poses: Pose, span: Array | None = None) -> Array:
    """Base and tool frame (12 numbers) in which the nominal machine is nearest to poses; none without frames.

    The rule of the whole package: least squares of the position and of 0.3 m/rad times the orientation. With a span
    (see `reachable`) only what lies in it counts, and what that leaves open stays near the true frames.
    """
    start = machine.vector("true")[: machine.frames]
    if not machine.frames:
        return start

    def misfit(frames: Array) -> Array:
        errors = apart(machine.nominal_pose(frames, joints), poses)
        if span is None:
            return errors.ravel()
        return np.concatenate([(span @ errors[..., None]).ravel(), _OPEN * (frames - start)])

    return np.asarray(least_squares(misfit, start, method="lm", x_scale=np.ones(12)).x)


def commands(machine: Machine, unknowns: Array, wanted: Pose, rows: Rows) -> Array:
    """Joints at which a machine with these unknowns is nearest to wanted poses: damped Newton from the ideal joints.

    A row takes a step only where it comes nearer, and is damped more where it does not. A redundant arm takes the
    smallest steps.
    """
    joints, damping = rows.joints.copy(), np.full(len(rows.joints), _DAMPING**2)

    def left(at: Array) -> Array:
        return apart(machine.pose(unknowns, at, rows.covariates), wanted)

    residual = left(joints)
    for _ in range(_NEWTON):
        slope = joint_slopes(lambda at: machine.pose(unknowns, at, rows.covariates), joints)
        normal = slope.swapaxes(1, 2) @ slope + damping[:, None, None] * np.eye(joints.shape[1])
        step = np.linalg.solve(normal, slope.swapaxes(1, 2) @ residual[..., None])[..., 0]
        tried = joints + step
        after = left(tried)
        better = (after**2).sum(-1) < (residual**2).sum(-1)
        joints[better], residual[better] = tried[better], after[better]
        damping = np.where(better, damping / 4, damping * 8)
    return joints
