"""Errors of the drives: backlash, friction under a load, and periodic errors of gears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .absorb import joint_slopes
from .causes import Cause, changes_joints, named, on_joints
from .kinds import Floats
from .situation import Rows

__all__ = ["added_backlash", "added_friction", "added_latency", "added_transmission"]


def added_backlash(rows: Rows, rng: np.random.Generator) -> Cause:
    """Dead zone of one to three drives: the joint stays half of it behind the side it came from.

    In a part of the cases a short motion has not crossed all of the zone.
    """
    count = int(rng.integers(1, 4))
    chosen = rng.choice(rows.good_joints(), count, replace=False)
    sizes = rng.uniform(0.6, 1.4, count)
    crossed = np.ones_like(rows.way[:, chosen])
    smooth = rng.random() < 0.4
    if smooth:
        crossed = np.tanh(rows.way[:, chosen] / np.quantile(rows.way[:, chosen], 0.15, axis=0))
    change = on_joints(rows, chosen, -0.5 * sizes * rows.direction[:, chosen] * crossed)
    words = f"{'smooth ' if smooth else ''}dead zone of {names(chosen)}"
    return Cause(words, changes_joints(rows, change), named("backlash"), ("direction",), own=own_play(rows))


def added_friction(rows: Rows, rng: np.random.Generator) -> Cause:
    """Drives wound up against their last motion, by a share of the load's torque."""
    count = int(rng.integers(1, 4))
    chosen = rng.choice(rows.good_joints(), count, replace=False)
    sizes = rng.uniform(0.6, 1.4, count)
    change = on_joints(rows, chosen, -sizes * rows.direction[:, chosen] * np.abs(rows.torque()[:, chosen]) / 50)
    words, columns = f"friction under load of {names(chosen)}", ("direction", "load")
    return Cause(words, changes_joints(rows, change), named("friction"), columns, own=own_play(rows))


def added_transmission(rows: Rows, rng: np.random.Generator) -> Cause:
    """One or two harmonics of one or two gears, whole numbers a turn, at least two periods over the travel."""
    good = rows.good_joints(travel=1.0)
    chosen = rng.choice(good, int(rng.integers(1, 3)), replace=False)
    change = np.zeros_like(rows.joints)
    for joint in chosen:
        lowest = int(np.ceil(2 * 2 * np.pi / rows.span[joint]))
        frequency = int(rng.integers(lowest, lowest + 15))
        phase, angle = rng.uniform(0, 2 * np.pi, 2), frequency * rows.joints[:, joint]
        change[:, joint] = np.sin(angle + phase[0])
        if rng.random() < 0.5:
            change[:, joint] += 0.4 * np.sin(2 * angle + phase[1])
    return Cause(f"periodic error of {names(chosen)}", changes_joints(rows, change), named("transmission"))


def added_latency(rows: Rows, rng: np.random.Generator) -> Cause:
    """Poses recorded on the move: all joints are late by one time, or each by a little more or less."""
    late = np.ones(rows.joints.shape[-1])
    if rng.random() < 0.4:
        late = rng.uniform(0.7, 1.3, late.shape)
    change = -late * rows.speed
    return Cause(
        "poses late behind the joints",
        changes_joints(rows, change),
        named("latency"),
        ("speed",),
        rows=replace(rows, direction=np.sign(rows.speed)),
    )


def own_play(rows: Rows) -> tuple[Floats, ...]:
    """Errors of position by the directions that are recorded, one for each joint, `s x 3` [m]."""
    slopes = joint_slopes(rows.arm, rows.joints, False)
    return tuple(slopes[..., j] * rows.direction[:, j, None] for j in range(slopes.shape[-1]))


def names(joints: Floats) -> str:
    """Names of joints, for a sentence."""
    return ", ".join(f"q{j + 1}" for j in sorted(joints))
