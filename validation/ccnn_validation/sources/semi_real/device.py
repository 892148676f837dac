"""Errors of the measurement: gross outliers, axes of a wrong scale, and nothing at all."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .arm import Pose
from .causes import Cause, named
from .kinds import Floats
from .situation import Rows

__all__ = ["added_nothing", "added_outliers", "added_scale"]


def added_outliers(rows: Rows, rng: np.random.Generator) -> Cause:
    """Some five per cent of the rows are off by about ten times the arm's own error, in any direction."""
    count = len(rows.time)
    hit = rng.permutation(count)[: max(4, int(rng.uniform(0.03, 0.06) * count))]
    size = np.zeros((count, 1))
    size[hit, 0] = rng.uniform(8, 14, len(hit))
    shift = size * unit(rng, count)
    # The same in angle, at the lever that an arm of this size has; a reflector's shift does not turn the target.
    turned = size * unit(rng, count) * (0.3 if rng.random() < 0.5 else 0.0)

    def pose(strength: float) -> Pose:
        """Nominal poses, some of them moved."""
        nominal = rows.arm.pose(rows.joints)
        turn = Rotation.from_rotvec(strength * turned).as_matrix()
        return Pose(nominal.position + strength * shift, turn @ nominal.rotation)

    # Strength 0: each bad row is off by eight to fourteen times the arm's own error, as `make` gives it.
    return Cause(f"{len(hit)} gross outliers", pose, named("outlier"), strengths=(0.0,))


def added_scale(rows: Rows, rng: np.random.Generator) -> Cause:
    """A measuring device whose axes have different scales; equal ones could as well be longer links."""
    scale = rng.normal(size=3)
    scale = scale - scale.mean() + 0.3 * rng.normal()
    pull = rows.robot.seen.base.T @ np.diag(scale) @ rows.robot.seen.base

    def pose(strength: float) -> Pose:
        """Positions drawn out along the tracker's axes, about the middle of the rows."""
        nominal = rows.arm.pose(rows.joints)
        away = nominal.position - nominal.position.mean(0)
        return Pose(nominal.position + strength * away @ pull.T, nominal.rotation)

    strengths = (0.25, 0.5) if rows.robot.name == "wam_tracker" else (0.25, 0.5, 1.0)
    return Cause("scales of the tracker's axes", pose, named("instrument"), strengths=strengths)


def added_nothing(rows: Rows, rng: np.random.Generator) -> Cause:
    """Nothing but columns that nothing depends on."""
    return Cause("nothing", lambda strength: rows.arm.pose(rows.joints), (frozenset(),), strengths=(0.0,))


def unit(rng: np.random.Generator, count: int) -> Floats:
    """Random directions, `s x 3`."""
    drawn = rng.normal(size=(count, 3))
    out: Floats = drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)
    return out
