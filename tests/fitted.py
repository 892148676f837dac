"""An arm of six axes, and geometry fitted to rows as `ccnn run` fits it, for tests of machines and frames."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.diagnosis.joint_fit import fit_jointly
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.mechanism_file import chain_of
from ccnn_torch.numerics.rotations import matrix_to_euler_zyx, matrix_to_rotation_vector

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
    return as_urdf(SerialArm("arm", "standard", LINKS, limits=LIMITS, tool=(0.05, 0.02, 0.1, 0.0, 0.0, 0.0)))


def as_urdf(arm: SerialArm) -> SerialArm:
    """The same arm with six parameters a link."""
    base, origins, last = chain_of(arm)
    links = [[*place.tolist(), *matrix_to_euler_zyx(turn).flip(-1).tolist()] for turn, place in origins]
    ends = {
        name: [*place.tolist(), *matrix_to_rotation_vector(turn).tolist()]
        for name, (turn, place) in (("base", base), ("tool", last))
    }
    keys = {"convention": "urdf", "links": links, "leans": [], "tool_offset": None}
    return SerialArm(**{**arm.recipe["keys"], **keys, **ends, "unknown_frames": list(arm.unknown_frames)})


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
