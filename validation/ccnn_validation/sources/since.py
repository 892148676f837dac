"""Causes that the diagnosis once called by a wrong name, on machines of the workshop: new physics, new seeds.

Links that bend between their joints, a machine with two temperatures, and an instrument whose channels share their
noise. The physics is in numpy alone; whoever wrote it knew the effects. Seeds below 100 were looked at while the
diagnosis was mended: figures come from 500 on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ccnn_torch.errors import InputError
from ccnn_validation.sources.case import SourceCase, Truth
from ccnn_validation.sources.shop.arms import Arm
from ccnn_validation.sources.shop.cases import built
from ccnn_validation.sources.shop.cause import Cause, Random
from ccnn_validation.sources.shop.deal import Dealt
from ccnn_validation.sources.shop.machine import GRAVITY, Array, Errors, Machine, Pose, Rows

__all__ = ["CAUSES", "FAMILIES", "make"]

_EVERY = ("painter6", "arm7", "scara", "gantry", "five_bar", "delta", "stewart", "delta_linear")
_GROWING = ("painter6", "arm7", "scara", "gantry", "delta_linear", "stewart")
_DEALT: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "bending_weight": ("bending_weight", "single", ("painter6", "arm7")),
    "bending_load": ("bending_load", "single", ("painter6", "arm7")),
    "two_temperatures": ("two_temperatures", "single", _GROWING),
    "one_of_two_temperatures": ("one_of_two", "single", _GROWING),
    "correlated": ("correlated", "none", _EVERY),
    "range_azimuth": ("range_azimuth", "none", _EVERY),
}
"""Family: cause or noise, kind, machines in turn."""
FAMILIES = tuple(_DEALT)


def make(family: str, seed: int) -> SourceCase:
    """The case of a family and seed; the same for the same arguments.

    Raises:
        InputError: there is no such family.
    """
    if family not in _DEALT:
        raise InputError(f"since: family '{family}' is not there; known: {', '.join(FAMILIES)}")
    name, kind, machines = _DEALT[family]
    machine = machines[seed % len(machines)]
    case = built(Dealt(f"{machine}_{family}", machine, (name,), kind), seed, CAUSES)
    if name == "one_of_two":
        # What follows a thermometer that is not there may be told as growth, as outside, or both.
        truth = Truth("outside", (name,), (frozenset({"thermal"}), frozenset()), None)
        return replace(case, truth=truth)
    return case


_GIVES = 3e-4
"""What the beams of a machine give at strength 1, root mean square [m]."""


def _bending_weight(machine: Machine, rng: Random) -> Cause:
    """Links that bend and twist as beams under their own weight and that of all beyond them."""
    still = np.zeros(3)
    bent = _beams(machine, rng, 1.0, still)
    return Cause(("bending", "gravity"), moved=lambda pose, rows, k: bent(pose, rows.joints, k, 1.0, still))


def _bending_load(machine: Machine, rng: Random) -> Cause:
    """The same under the recorded load alone: the own weight was there when the machine was calibrated."""
    bent = _beams(machine, rng, 0.0, np.array([30.0, 30.0, 30.0]))
    return Cause(
        ("bending", "compliance"),
        moved=lambda pose, rows, k: bent(pose, rows.joints, k, 0.0, rows.load),
        needs=("load",),
    )


def _across(vectors: Array, axis: Array) -> Array:
    """The part across an axis, `s x 3` each."""
    return np.asarray(vectors - (vectors * axis).sum(1, keepdims=True) * axis)


def _beams(
    machine: Machine, rng: Random, usual: float, pulled: Array
) -> Callable[[Pose, Array, float, float, Array], Pose]:
    """Euler-Bernoulli beams of one section each, clamped at the joint before: three links at most are soft.

    usual, pulled: weight [1] and load [N] under which the beams give as much as ordinary ones.
    """
    assert isinstance(machine, Arm)
    length = np.hypot(machine.a, machine.d)
    long = np.flatnonzero(length > 0.2)
    soft = rng.choice(long, min(len(long), int(rng.integers(1, 4))), False)
    softness = np.zeros(machine.count)
    softness[soft] = rng.uniform(0.5, 1.5, len(soft))
    twisting = rng.uniform(0.8, 2.0)

    def bent(pose: Pose, joints: Array, k: float, weight: float, load: Array) -> Pose:
        ends = _ends(machine, joints)
        shift, turn = np.zeros_like(pose[0]), np.zeros_like(pose[0])
        masses = weight * GRAVITY * machine.mass
        for i in np.flatnonzero(softness):
            start, end = ends[:, i], ends[:, i + 1]
            beam = end - start
            along = np.linalg.norm(beam, axis=1, keepdims=True)
            axis = beam / along
            force = np.broadcast_to(load, pose[0].shape).copy()
            moment = np.cross(pose[0] - end, force)
            for j in range(i + 1, machine.count):
                pull = masses[j] * machine.down
                force += pull
                moment += np.cross((ends[:, j] + ends[:, j + 1]) / 2 - end, np.broadcast_to(pull, end.shape))
            tool = masses[-1] * machine.down
            force, moment = force + tool, moment + np.cross(pose[0] - end, np.broadcast_to(tool, end.shape))
            line = masses[i] * machine.down / along
            twist = (moment * axis).sum(1, keepdims=True) * axis
            turned = (
                np.cross(axis, _across(force, axis)) * along**2 / 2
                + _across(moment, axis) * along
                + twist * along * twisting
                + np.cross(axis, _across(line, axis)) * along**3 / 6
            )
            sunk = (
                _across(force, axis) * along**3 / 3
                + np.cross(_across(moment, axis), axis) * along**2 / 2
                + _across(line, axis) * along**4 / 8
            )
            shift += k * softness[i] * (sunk + np.cross(turned, pose[0] - end))
            turn += k * softness[i] * turned
        rotation = np.stack([_small(t) for t in turn])
        return pose[0] + shift, rotation @ pose[1]

    places = machine.plan(100, np.random.default_rng(0), "random")
    still = machine.pose(places)
    softness *= 1e-9
    gives = bent(still, places, 1.0, usual, pulled)[0] - still[0]
    softness *= _GIVES / np.sqrt((gives**2).sum(1).mean())
    return bent


def _ends(arm: Arm, joints: Array) -> Array:
    """Origins of the base and of all links, `s x (n + 1) x 3`."""
    found = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    ends = [found[:, :3, 3]]
    for i in range(arm.count):
        cos, sin = np.cos(joints[:, i] + arm.theta[i]), np.sin(joints[:, i] + arm.theta[i])
        ca, sa, zero, one = np.cos(arm.alpha[i]), np.sin(arm.alpha[i]), np.zeros_like(cos), np.ones_like(cos)
        step = np.stack(
            [
                np.stack([cos, -sin * ca, sin * sa, arm.a[i] * cos], -1),
                np.stack([sin, cos * ca, -cos * sa, arm.a[i] * sin], -1),
                np.stack([zero, sa * one, ca * one, arm.d[i] * one], -1),
                np.stack([zero, zero, zero, one], -1),
            ],
            -2,
        )
        found = found @ step
        ends.append(found[:, :3, 3])
    return np.stack(ends, 1)


def _small(turn: Array) -> Array:
    """Rotation matrix of a rotation vector, by Rodrigues' formula."""
    angle = float(np.linalg.norm(turn))
    cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    if angle < 1e-12:
        return np.asarray(np.eye(3) + cross)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross)


def _two_temperatures(machine: Machine, rng: Random, recorded: bool = True) -> Cause:
    """Parts that grow with the hall, and others with the drives, which are warmer by what work and pauses make."""
    expansion = rng.choice([11.7e-6, 23e-6])
    near = rng.permutation(machine.count) < rng.integers(1, machine.count)
    late, rise, pauses = rng.uniform(0.05, 0.2), rng.uniform(6, 12), np.sort(rng.uniform(0.2, 0.9, 4))

    def drives(rows: Rows) -> Array:
        time = rows.columns["time"] / rows.columns["time"][-1]
        warm = np.zeros_like(time)
        for i in range(1, len(time)):
            works = np.searchsorted(pauses, time[i]) % 2 == 0
            warm[i] = warm[i - 1] + (rise * works - warm[i - 1]) * -np.expm1(-(time[i] - time[i - 1]) / late)
        return np.asarray(rows.columns["temperature"] + warm)

    def growth(rows: Rows, k: float) -> Errors:
        hall, warm = (k * expansion * (t - 20) for t in (rows.columns["temperature"], drives(rows)))
        if isinstance(machine, Arm):
            return {"growth": np.where(near, warm[:, None], hall[:, None])}
        return {"growth": hall, "joints": (warm - hall)[:, None] * rows.joints}

    adds = (lambda rows: {"temperature_drives": drives(rows)}) if recorded else None
    return Cause(("thermal",), growth, needs=("temperature", "time"), adds=adds)


def _one_of_two(machine: Machine, rng: Random) -> Cause:
    """The same where the hall's thermometer alone was recorded."""
    return _two_temperatures(machine, rng, recorded=False)


CAUSES = {
    "bending_weight": _bending_weight,
    "bending_load": _bending_load,
    "two_temperatures": _two_temperatures,
    "one_of_two": _one_of_two,
}
"""What `built` may deal here besides the causes of the workshop."""
