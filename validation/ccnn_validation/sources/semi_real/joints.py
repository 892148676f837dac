"""Errors that follow the joints: gain, coupling, a local bump, and a product that no library names."""

from __future__ import annotations

import numpy as np

from .absorb import gain_basis
from .causes import Cause, changes_joints, named, on_joints
from .kinds import Floats
from .situation import Rows

__all__ = ["added_coupling", "added_joint_gain", "added_local", "added_product"]

NOTHING: frozenset[str] = frozenset()


def added_joint_gain(rows: Rows, rng: np.random.Generator) -> Cause:
    """One joint that moves by a share too far or too short.

    A Denavit-Hartenberg table has no gains, and couplings of all pairs that could follow one are the longer story.
    """
    joint = int(rng.choice(rows.good_joints(travel=1.0)))
    change = on_joints(rows, np.array([joint]), rng.choice([-1, 1]) * centred(rows, joint)[:, None])
    return Cause(
        f"gain of q{joint + 1}",
        changes_joints(rows, change),
        named("joint_gain"),
    )


def added_coupling(rows: Rows, rng: np.random.Generator) -> Cause:
    """One joint that turns another one, neighbours most of the time; cases that gains explain are not drawn."""
    good = rows.good_joints(travel=0.0)
    moved = int(rng.choice(good))
    moving = np.setdiff1d(np.flatnonzero(rows.span > 0.8), [moved])
    near = 1.0 / np.abs(moving - moved) ** 2
    j = int(rng.choice(moving, p=near / near.sum()))
    change = on_joints(rows, np.array([moved]), rng.choice([-1, 1]) * centred(rows, j)[:, None])
    oriented = rows.turn is not None
    return Cause(
        f"q{j + 1} turns q{moved + 1}",
        changes_joints(rows, change),
        named("coupling"),
        others=tuple(gain_basis(rows.arm, rows.joints, oriented, coupled=False)),
        least_share=0.4,
    )


def added_local(rows: Rows, rng: np.random.Generator) -> Cause:
    """A bump in one joint's angle, narrower than what a few harmonics of a gear could follow."""
    joint = int(rng.choice(rows.good_joints(travel=1.0)))
    values = rows.joints[:, joint]
    centre, width = np.quantile(values, rng.uniform(0.25, 0.75)), rng.uniform(0.03, 0.06) * rows.span[joint]
    bump = rng.choice([-1, 1]) * np.exp(-((values - centre) ** 2) / (2 * width**2))
    # Where the first joint stands is a sector of the workspace as well.
    drivers = ("q1", "position") if joint == 0 else (f"q{joint + 1}",)
    enough = 12 <= np.count_nonzero(np.abs(bump) > 0.6) <= 0.3 * len(values)
    return Cause(
        f"bump in q{joint + 1} at {centre:.2f} rad, {width:.2f} rad wide",
        changes_joints(rows, on_joints(rows, np.array([joint]), bump[:, None])),
        (NOTHING,),
        strengths=(0.5, 1.0),
        outside=True,
        drivers=drivers,
        fit=bool(enough),
    )


def added_product(rows: Rows, rng: np.random.Generator) -> Cause:
    """One joint that is off by the product of two other joints; cases that gains or couplings explain are not drawn."""
    moved = int(rng.choice(rows.good_joints(travel=0.0)))
    j, k = rng.choice(np.setdiff1d(np.flatnonzero(rows.span > 0.8), [moved]), 2, replace=False)
    change = on_joints(rows, np.array([moved]), (centred(rows, int(j)) * centred(rows, int(k)))[:, None])
    oriented = rows.turn is not None
    bases = [gain_basis(rows.arm, rows.joints, oriented, coupled) for coupled in (False, True)]
    return Cause(
        f"q{moved + 1} is off by the product of q{min(j, k) + 1} and q{max(j, k) + 1}",
        changes_joints(rows, change),
        (NOTHING,),
        strengths=(0.5, 1.0, 3.0),
        outside=True,
        drivers=tuple(f"q{i + 1}" for i in sorted((int(j), int(k)))),
        others=tuple(bases[0] + bases[1]),
        least_share=0.5,
    )


def centred(rows: Rows, joint: int) -> Floats:
    """A joint less its middle, `s` [rad]."""
    out: Floats = rows.joints[:, joint] - rows.middle[joint]
    return out
