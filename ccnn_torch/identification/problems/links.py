"""Link parameters of a serial arm from measured poses: Bayesian least squares around the maker's geometry."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, TOOL_SPREAD
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.pose import frame_gap
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.outliers import inlying

# The noise and the parameters are estimated in turn; the noise has settled after two rounds.
_ROUNDS = 3


def fit_links(
    arm: SerialArm,
    joints: Tensor,
    pose: Tensor,
    start: Tensor,
    weights: Tensor | None = None,
    rotation_weight: float = ROTATION_WEIGHT,
    length_tolerance: float = 1e-3,
    angle_tolerance: float = 1e-3,
) -> Tensor:
    """Fit all link parameters, and with them the frames that are unknown, in each repeat on its own rows.

    Every link parameter is drawn to the maker's value with the tolerance as standard deviation, against the noise that
    the rows show: what the rows do not determine (two parallel axes, a tool length along the last axis) stays nominal,
    so that nothing needs to be left out by hand. Frames in `arm.unknown_frames` are free but for the tool's position,
    as in `fit_frames`. Gross outliers are left out.

    Args:
        arm: the arm, with one base and one tool frame for all rows.
        joints: `s x n` [SI].
        pose: measured, `s x p` [SI].
        start: parameters with the frames fitted, as `fit_frames` returns them, `r x k` or `k` [SI].
        weights: `r x s` or `s` [1]; 0 leaves a row out (held-out rows); all 1 when None.
        rotation_weight: [m/rad].
        length_tolerance: of the lengths in the links [m].
        angle_tolerance: of the angles in the links [rad].

    Returns:
        All parameters, as `start`.
    """
    weights = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
    position, rotation = arm.frame(pose)
    unit = {"m": 1 / length_tolerance, "rad": 1 / angle_tolerance}
    stiffness = torch.tensor([unit[p.unit] for p in arm.geometry], dtype=torch.float64)
    for name, part in (("base", slice(0, 6)), ("tool", slice(-6, None))):
        if name in arm.unknown_frames:
            stiffness[part] = 0
    if "tool" in arm.unknown_frames:
        stiffness[-6:-3] = 1 / (TOOL_SPREAD * arm.reach)
    # Priors hold the links; the frames are what the rows alone decide.
    free = 12 if rotation is not None else 9

    def gap(values: Tensor) -> Tensor:
        """Pose difference, `... x s x c` [m]. values: `... x s x k`."""
        return frame_gap(arm.forward_frame(joints, values), (position, rotation), rotation_weight)

    def by_row(values: Tensor) -> Tensor:
        return values[..., None, :].expand(*values.shape[:-1], len(joints), -1)

    value = start
    for _ in range(_ROUNDS):
        left = gap(by_row(value))
        kept = weights * inlying(torch.linalg.vector_norm(left, dim=-1), weights > 0, left.shape[-1], free)
        square = (kept * left.square().mean(-1)).sum(-1) / kept.sum(-1)
        pull = square.sqrt()[..., None] * stiffness
        root = kept.sqrt()[..., None]

        def residual(values: Tensor, pull: Tensor = pull, root: Tensor = root) -> Tensor:
            return torch.cat([(gap(by_row(values)) * root).flatten(-2), (values - arm.nominal) * pull], dim=-1)

        def slope(values: Tensor, pull: Tensor = pull, root: Tensor = root) -> Tensor:
            # The derivative of log(R Rmᵀ) is taken as the rate of rotation itself: the gradient is the same.
            rows = arm.parameter_jacobian(joints, by_row(values))
            rows[..., 3:, :] *= rotation_weight
            rows = rows * root[..., None]
            return torch.cat([rows.flatten(-3, -2), torch.diag_embed(pull)], dim=-2)

        value = levenberg_marquardt(residual, value, slope, max_iterations=20, damping=1e-6).value
    return value
