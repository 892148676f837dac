"""Deflections: springs of joints and links under a load, and sag under the arm's own weight."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .absorb import gain_basis, joint_slopes
from .arm import Pose
from .causes import Cause, changes_joints, named, on_joints
from .drives import names
from .kinds import Floats
from .situation import Rows

__all__ = ["added_compliance", "added_gravity_sag"]

# Rough weights of the links [kg]; only their proportions matter.
WEIGHTS = {
    "ur10_a": (7.1, 12.7, 4.3, 2.0, 2.0, 0.4),
    "ur10_b": (7.1, 12.7, 4.3, 2.0, 2.0, 0.4),
    "ur5_tracker": (3.7, 8.4, 2.3, 1.2, 1.2, 0.2),
    "wam_tracker": (10.8, 3.9, 1.8, 2.4, 0.1, 0.4, 0.1),
}


def added_compliance(rows: Rows, rng: np.random.Generator) -> Cause:
    """Springs in some joints (torque by virtual work), or links that bend about the axes across their joint's."""
    if rng.random() < 0.5:
        chosen = rng.choice(rows.good_joints(), int(rng.integers(1, 4)), replace=False)
        change = on_joints(rows, chosen, rng.uniform(0.5, 1.5, len(chosen)) * rows.torque()[:, chosen] / 50)
        words = f"springs in {names(chosen)} under a load"
        return Cause(words, changes_joints(rows, change), named("compliance"), ("load",))
    link = int(rng.choice([1, 2])) if rows.joints.shape[-1] == 6 else 2
    origins, rotations = rows.arm.links(rows.joints)
    # The link beyond joint `link + 1` starts at that joint's origin; about the joint's own axis the drive turns.
    start, axis = origins[:, link], rotations[:, link, :, 2]
    reach = rows.arm.pose(rows.joints).position - start
    moment = np.cross(reach, rows.load @ rows.robot.seen.base)
    bend = (moment - (moment * axis).sum(-1, keepdims=True) * axis) / 50

    def pose(strength: float) -> Pose:
        """The arm beyond the link's start turned about it."""
        nominal = rows.arm.pose(rows.joints)
        turn = Rotation.from_rotvec(strength * bend).as_matrix()
        return Pose(start + (turn @ reach[..., None])[..., 0], turn @ nominal.rotation)

    return Cause(f"link {link + 1} bends under a load", pose, named("compliance"), ("load",))


def added_gravity_sag(rows: Rows, rng: np.random.Generator) -> Cause:
    """Joints that give way under the arm's weight, the base upright. The measured arms may sag already."""
    payload = rng.uniform(0, 3)
    torque = weight_torque(rows, payload)
    softness = rng.uniform(0.7, 1.5, torque.shape[-1])
    soft = [int(j) for j in rows.good_joints() if torque[:, j].std() > 0.02 * torque.std()]
    change = on_joints(rows, np.array(soft), (softness * torque)[:, soft] / 50)
    slopes = joint_slopes(rows.arm, rows.joints, False)
    return Cause(
        f"sag under the own weight of {names(np.array(soft))}",
        changes_joints(rows, change),
        named("gravity"),
        strengths=(1.0, 3.0),
        own=tuple(slopes[..., j] * torque[:, j, None] for j in soft),
        others=tuple(gain_basis(rows.arm, rows.joints, rows.turn is not None, coupled=False)),
        least_share=0.3,
    )


def weight_torque(rows: Rows, payload: float) -> Floats:
    """Torque of the own weight on the joints, `s x n` [N*m]; links weigh halfway, the payload [kg] at the tool."""
    origins, rotations = rows.arm.links(rows.joints)
    point = rows.arm.pose(rows.joints).position
    axes = rotations[:, :-1, :, 2]
    centres = np.concatenate([(origins[:, 1:] + origins[:, :-1]) / 2, point[:, None]], 1)
    weights = np.array([*WEIGHTS[rows.robot.name], payload])
    n = axes.shape[1]
    carried = np.arange(n + 1)[None, :] >= np.arange(n)[:, None]
    levers = centres[:, None] - origins[:, :n, None]
    push = np.cross(levers, np.array([0.0, 0.0, -9.81]))
    out: Floats = np.einsum("snc,snmc,nm,m->sn", axes, push, carried.astype(float), weights)
    return out
