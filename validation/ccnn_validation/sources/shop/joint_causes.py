"""Causes of the library that act at the joints, in the forms of somebody who had read its documentation only."""

from __future__ import annotations

import numpy as np

from ccnn_validation.sources.shop.cause import INNER, Cause, Random, ordinary, picked, with_joints
from ccnn_validation.sources.shop.machine import Array, Machine, Rows, of_load, of_weight

__all__ = [
    *("backlash", "compliance", "coupling", "drift", "friction", "gravity", "joint_gain", "joint_offset"),
    *("latency", "transmission"),
]


def joint_offset(machine: Machine, rng: Random) -> Cause:
    """Zeros of joints; a gantry's is a shift of its frame."""
    size = picked(machine, rng, INNER.get(machine.name)) * 3 * ordinary(machine)
    also = ("frame",) if machine.name == "gantry" else ()
    return with_joints("joint_offset", lambda rows, k: k * size + 0 * rows.joints, also=also)


def joint_gain(machine: Machine, rng: Random) -> Cause:
    """A wrong ratio or pitch; a gantry's is the scale of the instrument along that axis."""
    gain = picked(machine, rng) * (3e-4 if machine.joint_units[0] == "rad" else 1e-4)
    also = ("instrument",) if machine.name == "gantry" else ()
    return with_joints("joint_gain", lambda rows, k: k * gain * (rows.joints - rows.joints.mean(0)), also=also)


def transmission(machine: Machine, rng: Random) -> Cause:
    """A wave of the joint and its second harmonic, 1.5 to 40 periods over the travel."""
    size = picked(machine, rng) * ordinary(machine) * 1.5
    phase = rng.uniform(0, 6.28, machine.count)
    wide = 2 if machine.name == "gantry" else 1
    lead = rng.choice([0.02, 0.025, 0.04]) * wide if machine.count != 6 else 0.02
    rate = np.array(
        [rng.choice([4, 6, 8, 12, 16, 20, 24, 36]) if u == "rad" else 2 * np.pi / lead for u in machine.joint_units]
    )
    second = rng.uniform(0, 0.3)

    def wave(rows: Rows, k: float) -> Array:
        at = rate * rows.joints
        return np.asarray(k * size * (np.sin(at + phase) + second * np.sin(2 * at + 2 * phase + 1)))

    return with_joints("transmission", wave)


def backlash(machine: Machine, rng: Random) -> Cause:
    """Play: each joint stands on the side from which it came."""
    joints = {"painter6": [0, 3, 5], "arm7": [0, 2, 4, 6], "scara": [0, 1, 3]}.get(machine.name)
    play = np.abs(picked(machine, rng, joints)) * ordinary(machine)
    return with_joints("backlash", lambda rows, k: -k * play * rows.of_joints("direction"), "direction")


def friction(machine: Machine, rng: Random) -> Cause:
    """Coulomb friction in proportion to the joint's torque, and some without it, winds the drive up against motion."""
    wind = np.abs(picked(machine, rng, most=3)) * ordinary(machine) * 1.3

    def wound(rows: Rows, k: float) -> Array:
        torque = of_load(machine, rows) + of_weight(machine, rows.joints)
        pressed = np.abs(torque) / (_size(torque) + 1e-9) + 0.12
        return np.asarray(-k * wind * rows.of_joints("direction") * pressed)

    return with_joints("friction", wound, "direction", "load")


def compliance(machine: Machine, rng: Random) -> Cause:
    """Gears of two stiffnesses: softer below a knee. Joints that hardly feel the load do not give way."""
    give = np.abs(picked(machine, rng, most=3)) * ordinary(machine) * 1.5
    knee = rng.uniform(0.0, 0.4)

    def bent(rows: Rows, k: float) -> Array:
        torque = of_load(machine, rows)
        usual = _size(torque) + 1e-9
        usual[usual < 0.02 * usual.max()] = np.inf
        share = torque / usual
        return np.asarray(k * give * (share + knee * np.clip(share, -0.4, 0.4)))

    return with_joints("compliance", bent, "load")


def gravity(machine: Machine, rng: Random) -> Cause:
    """Joints that sag under the machine's own weight."""
    joints = {"painter6": [1, 2], "arm7": [1, 3, 5]}.get(machine.name)
    sag = np.abs(picked(machine, rng, joints, 3)) if joints else rng.uniform(0.8, 1.2, machine.count)
    sag = sag * ordinary(machine) * 1.5

    def sunk(rows: Rows, k: float) -> Array:
        torque = of_weight(machine, rows.joints)
        return np.asarray(k * sag * torque / (_size(torque) + 1e-9))

    return with_joints("gravity", sunk)


def drift(machine: Machine, rng: Random) -> Cause:
    """Joints that creep, evenly or as a logarithm."""
    size = picked(machine, rng) * ordinary(machine) * 2
    slows = rng.random() < 0.5

    def crept(rows: Rows, k: float) -> Array:
        time = rows.columns["time"]
        return np.asarray(k * size * (np.log1p(time / 1800) / 2 if slows else time / 2e4)[:, None])

    return with_joints("drift", crept, "time")


def coupling(machine: Machine, rng: Random) -> Cause:
    """A joint that the drive of the one before it turns along."""
    pairs = {
        "painter6": [(4, 3), (5, 4), (5, 3)],
        "arm7": [(5, 4), (6, 5)],
        "scara": [(1, 0), (2, 3)],
        "planar3r": [(1, 0), (2, 1)],
    }
    driven, driver = pairs[machine.name][rng.integers(2)]
    share = (3e-4 if machine.joint_units[driven] == "rad" else 3e-5) * rng.uniform(0.6, 1.4)

    def turned(rows: Rows, k: float) -> Array:
        found = np.zeros_like(rows.joints)
        found[:, driven] = k * share * (rows.joints[:, driver] - (machine.low + machine.high)[driver] / 2)
        return found

    return with_joints("coupling", turned)


def latency(machine: Machine, rng: Random) -> Cause:
    """Servos of the first order [s]; exact to the second order of a slow motion."""
    late = rng.uniform(1e-3, 4e-3) * (1 + 0.2 * rng.uniform(-1, 1, machine.count))

    def behind(rows: Rows, k: float) -> Array:
        assert rows.acceleration is not None, "machines with a latency are measured in motion"
        return np.asarray(-k * late * (rows.of_joints("speed") - k * late * rows.acceleration))

    return with_joints("latency", behind, "speed")


def _size(values: Array) -> Array:
    return np.asarray(np.sqrt((values**2).mean(0)))
