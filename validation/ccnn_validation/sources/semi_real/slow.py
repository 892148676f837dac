"""Errors that come with time and warmth: thermal growth, drift, and a jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .absorb import joint_slopes
from .arm import Pose
from .causes import Cause, changes_joints, named, on_joints
from .drives import names
from .kinds import Floats
from .situation import Rows, smooth_course

__all__ = ["added_drift", "added_jump", "added_thermal"]


def added_thermal(rows: Rows, rng: np.random.Generator) -> Cause:
    """Links that grow in length with the temperature, or a drive that turns with it; at once, or late."""
    lag = float(rng.uniform(0.02, 0.06) * rows.time[-1]) if rng.random() < 0.4 else 0.0
    hall, machine = smooth_course(rng, rows.time, rng.uniform(19.5, 22.5), rng.uniform(4, 7), lag)
    warmth = (machine - 20)[:, None]
    columns = ("temperature", "time") if lag else ("temperature",)
    late = " late" if lag else ""
    oriented = rows.turn is not None
    slopes = joint_slopes(rows.arm, rows.joints, oriented)
    trends = (rows.time / rows.time[-1], np.log1p(rows.time / (0.1 * rows.time[-1])))
    others = tuple(slopes[..., j] * (t - t.mean())[:, None] for t in trends for j in range(slopes.shape[-1]))
    warmed = replace(rows, temperature=hall)
    # Growth of a WAM's size of error would need hundreds of kelvin: there a cable's stretch turns a joint.
    if rows.robot.name != "wam_tracker" and rng.random() < 0.6:
        lengths = np.abs(rows.arm.a) + np.abs(rows.arm.d)
        share = np.ones_like(lengths)
        if rng.random() < 0.4:
            share = (np.arange(len(lengths)) == rng.choice(np.flatnonzero(lengths > 0.3))).astype(float)

        def pose(strength: float) -> Pose:
            """The arm with longer links."""
            growth = 1 + strength * share * warmth * 1e-5
            return rows.arm.with_values(a=rows.arm.a * growth, d=rows.arm.d * growth).pose(rows.joints)

        words = f"links that grow with the temperature{late}"
        return Cause(words, pose, named("thermal"), columns, (0.25, 0.5), others=others, least_share=0.5, rows=warmed)
    chosen = rng.choice(rows.good_joints(), int(rng.integers(1, 3)), replace=False)
    change = on_joints(rows, chosen, 1e-4 * warmth * rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.4, len(chosen)))
    words = f"{names(chosen)} turned by warmth{late}"
    strengths = (0.25, 0.5, 1.0)
    move = changes_joints(rows, change)
    return Cause(words, move, named("thermal"), columns, strengths, others=others, least_share=0.5, rows=warmed)


def added_drift(rows: Rows, rng: np.random.Generator) -> Cause:
    """Zero of one joint that runs away, evenly or fast at first."""
    joint = rng.choice(rows.good_joints(travel=0.0), 1)
    end = rows.time[-1]
    even = rng.random() < 0.5
    course = rows.time / end if even else np.log1p(rows.time / (rng.uniform(0.02, 0.2) * end))
    slopes = joint_slopes(rows.arm, rows.joints, False)
    return Cause(
        f"{names(joint)} drifts {'evenly' if even else 'fast at first'}",
        changes_joints(rows, on_joints(rows, joint, course[:, None])),
        named("drift"),
        ("time",),
        clashes=likeness(rows, course),
        own=tuple(slopes[..., j] * (course - course.mean())[:, None] for j in range(slopes.shape[-1])),
    )


def added_jump(rows: Rows, rng: np.random.Generator) -> Cause:
    """Zero of a joint, or the tool, that jumps once in the middle part of the measurement."""
    at = int(rng.uniform(0.35, 0.65) * len(rows.time))
    after = (np.arange(len(rows.time)) >= at).astype(float)[:, None]
    clashes, strengths = likeness(rows, after[:, 0]), (0.5, 1.0, 3.0)
    nothing: frozenset[str] = frozenset()
    if rng.random() < 0.6:
        joint = rng.choice(rows.good_joints(travel=0.0), 1)
        # A step is a change in time as well: a drift may be named for the part of it that a slope takes.
        accepted: tuple[frozenset[str], ...] = (nothing, frozenset({"drift"}))
        move, words = changes_joints(rows, on_joints(rows, joint, after)), f"{names(joint)} jumps at row {at}"
    else:
        shift = rng.normal(size=3)
        accepted, words = (nothing,), f"the tool jumps at row {at}"

        def move(strength: float) -> Pose:
            """The arm with a tool that is moved in the later rows."""
            return rows.arm.with_values(tool=rows.arm.tool + strength * after * shift).pose(rows.joints)

    return Cause(words, move, accepted, ("time",), strengths, True, ("time",), clashes)


def likeness(rows: Rows, course: Floats) -> tuple[str, ...]:
    """`temperature` where the hall's temperature by chance went like this course, `s`."""
    return ("temperature",) if abs(np.corrcoef(rows.temperature, course)[0, 1]) > 0.5 else ()
