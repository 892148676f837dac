"""Geometry fitted to rows as `ccnn run` fits it, for tests of machines and frames."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.joint_fit import fit_jointly
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.mechanisms import Mechanism


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
