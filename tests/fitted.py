"""An arm of six axes, and geometry fitted to rows as `ccnn run` fits it, for tests of machines and frames."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.joint_fit import fit_jointly
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.mechanisms import Mechanism, SerialArm

LIMITS = [(-1.5, 1.5), (-1.2, -0.3), (0.4, 1.6), (-1.5, 1.5), (0.3, 1.6), (-2.0, 2.0)]
QUARTER = 1.5707963267948966
# a, alpha, d, theta of each link.
LINKS = [
    [0.05, -QUARTER, 0.3, 0.0],
    [0.4, 0.0, 0.0, 0.0],
    [0.03, -QUARTER, 0.0, 0.0],
    [0.0, QUARTER, 0.4, 0.0],
    [0.0, -QUARTER, 0.0, 0.0],
    [0.0, 0.0, 0.08, 0.0],
]


def six_axis_arm() -> SerialArm:
    """In the URDF form, its elbow and its wrist on one branch."""
    tool = (0.05, 0.02, 0.1, 0.0, 0.0, 0.0)
    return SerialArm("arm", "standard", LINKS, limits=LIMITS, tool=tool).with_link_frames()


def fitted_geometry(
    mechanism: Mechanism, joints: Tensor, pose: Tensor, frames: Tensor | None = None, rows: Tensor | None = None
) -> Tensor:
    """All parameters, `k` [SI].

    Args:
        joints, pose: commanded and measured, `s x n` and `s x p` [SI].
        frames: parameters with fitted frames, `k`; nominal when None.
        rows: fitted to, `s` bool; all when None.
    """
    machine = mechanism if frames is None else mechanism.with_nominal(frames)
    guess = pose if pose.shape[-1] == len(mechanism.pose) else None
    situation = Situation(machine, joints, {}, default_gravity(mechanism), None, guess)
    usable = torch.ones(len(joints), dtype=torch.bool) if rows is None else rows
    return fit_jointly(situation, pose, [], usable, range(len(mechanism.geometry))).parameters
