"""Errors of the joints that no textbook names, `s x n` each, of arbitrary size."""

from __future__ import annotations

import numpy as np

from ccnn_validation.sources.adversarial.machine import Array
from ccnn_validation.sources.adversarial.rig import Rig

__all__ = ["bump", "cable", "eccentricity", "hysteresis", "of_travel", "stribeck", "table"]


def of_travel(rig: Rig) -> Array:
    """Joints as a share of their travel, 0 to 1, `s x n`."""
    low, high = rig.machine.span
    return np.asarray((rig.joints - low) / (high - low))


def bump(rig: Rig, joint: int) -> Array:
    """A damaged place of a guide: a bell of 4 % of the travel, with at least 8 rows on it."""
    way = of_travel(rig)[:, joint]
    # Centred on a row of the middle half, so that there are rows.
    ordered = np.sort(way)
    centre = ordered[int(rig.rng.integers(rig.rows // 4, 3 * rig.rows // 4))]
    width = max(0.04, float(np.sort(np.abs(way - centre))[8]))
    change = np.zeros_like(rig.joints)
    change[:, joint] = np.exp(-0.5 * ((way - centre) / width) ** 2)
    return change


def cable(rig: Rig) -> Array:
    """A cable along joint 1 that becomes taut at 40 to 60 % of its travel and pulls by the square of its stretch."""
    change = np.zeros_like(rig.joints)
    change[:, 0] = -(np.maximum(of_travel(rig)[:, 0] - rig.rng.uniform(0.4, 0.6), 0.0) ** 2)
    return change


def eccentricity(rig: Rig, joint: int) -> Array:
    """An encoder's disc off its axis, and bent: once a turn, and 0.4 of that twice a turn."""
    angle, phase = rig.joints[:, joint], rig.rng.uniform(0, 2 * np.pi, 2)
    change = np.zeros_like(rig.joints)
    change[:, joint] = np.sin(angle + phase[0]) + 0.4 * np.sin(2 * angle + phase[1])
    return change


def table(rig: Rig, joint: int) -> Array:
    """A correction table of 10 to 14 nodes over the travel, straight between them, added instead of taken away."""
    nodes = int(rig.rng.integers(10, 15))
    values = rig.rng.normal(size=nodes)
    change = np.zeros_like(rig.joints)
    change[:, joint] = 2 * np.interp(of_travel(rig)[:, joint], np.linspace(0, 1, nodes), values)
    return change


def hysteresis(rig: Rig, joint: int) -> Array:
    """Play operators of four widths in parallel (Prandtl and Ishlinskii): the joint remembers its last reversals.

    The widths reach from 5 to 50 % of the travel, so that the largest are not closed by most moves.
    """
    way = of_travel(rig)[:, joint]
    widths = np.array([0.05, 0.15, 0.3, 0.5]) / 2
    weights = rig.rng.uniform(0.5, 1.5, 4) * np.array([1.0, 0.7, 0.5, 0.4])
    inner = np.full(4, way[0])
    held = np.empty((rig.rows, 4))
    # A play operator depends on its own past: the only loop over rows of this source.
    for row, place in enumerate(way):
        inner = np.clip(inner, place - widths, place + widths)
        held[row] = inner
    change = np.zeros_like(rig.joints)
    change[:, joint] = (held - way[:, None]) @ weights
    return change


def stribeck(rig: Rig, joint: int) -> Array:
    """Friction that falls with the speed of the last move (Stribeck), which grows with its way; not with the load."""
    way = of_travel(rig)[:, joint]
    moved = np.abs(np.diff(way, prepend=0.5))
    level = 1.0 + rig.rng.uniform(1.0, 2.0) * np.exp(-((moved / 0.15) ** 2))
    change = np.zeros_like(rig.joints)
    change[:, joint] = -rig.direction[:, joint] * level
    return change
