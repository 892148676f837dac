"""Parallel machines: a rotary delta, a Stewart platform and a planar five-bar, from joints to pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ccnn_validation.delivered.machine import Covariates, Pose
from ccnn_validation.delivered.rotation import Array

_STEPS = 30
"""Newton's steps at most; a step from home to a pose in the box takes five."""


def delta_pose(values: Mapping[str, Array], joints: Array, covariates: Covariates) -> Pose:
    """The lower of the two points at a rod's length from three shifted elbows.

    Blocks, three numbers each: base, platform (radii), crank, rod [m], angle [rad], offset [rad], gain [1].
    """
    del covariates
    turn = values["gain"] * joints + values["offset"]
    radius = values["base"] + values["crank"] * np.cos(turn) - values["platform"]
    elbow = np.stack(
        [radius * np.cos(values["angle"]), radius * np.sin(values["angle"]), -values["crank"] * np.sin(turn)], -1
    )
    return Pose(_three_spheres(elbow, values["rod"]), None)


def _three_spheres(centres: Array, radii: Array) -> Array:
    """The lower point at distances `3` [m] from centres `s x 3 x 3`; NaN where there is none."""
    first, across, along = centres[:, 0], centres[:, 1] - centres[:, 0], centres[:, 2] - centres[:, 0]
    normal = np.cross(across, along)
    # Foot of the point in the plane of the centres: equal powers with regard to the three spheres.
    ahead = ((across**2).sum(-1) + radii[0] ** 2 - radii[1] ** 2) / 2
    aside = ((along**2).sum(-1) + radii[0] ** 2 - radii[2] ** 2) / 2
    square = (normal**2).sum(-1)
    foot = (np.cross(along, normal) * ahead[:, None] + np.cross(normal, across) * aside[:, None]) / square[:, None]
    with np.errstate(invalid="ignore"):
        height = np.sqrt((radii[0] ** 2 - (foot**2).sum(-1)) / square)
    down = -np.sign(normal[:, 2])
    return np.asarray(first + foot + (down * height)[:, None] * normal)


def hexagon(radius: float, spread: float, turned: bool) -> Array:
    """Places of six joints in pairs on a circle, `6 x 3` [m]; `turned`: those of the platform."""
    pairs = np.deg2rad([60, 60, 180, 180, 300, 300] if turned else [0, 120, 120, 240, 240, 0])
    angles = pairs + spread * np.array([-1, 1, -1, 1, -1, 1] if turned else [1, -1, 1, -1, 1, -1])
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.zeros(6)], -1)


def leg_lengths(base: Array, platform: Array, position: Array, rotation: Array) -> Array:
    """Lengths of the legs, `s x 6` [m], of joints on base and platform, `6 x 3`."""
    legs = position[:, None] + np.einsum("sij,kj->ski", rotation, platform) - base
    return np.asarray(np.linalg.norm(legs, axis=-1))


def stewart_pose(home: Array, values: Mapping[str, Array], joints: Array, covariates: Covariates) -> Pose:
    """Pose of a Stewart platform by Newton's method from its home position [m], level.

    Blocks: base, platform `6 x 3` [m]; offset [m] and gain [1], six each.
    """
    del covariates
    wanted = values["gain"] * joints + values["offset"]
    rows = len(joints)
    position, rotation = np.tile(home, (rows, 1)), np.tile(np.eye(3), (rows, 1, 1))
    for _ in range(_STEPS):
        arms = np.einsum("sij,kj->ski", rotation, values["platform"])
        legs = position[:, None] + arms - values["base"]
        lengths = np.linalg.norm(legs, axis=-1)
        along = legs / lengths[..., None]
        # A leg grows by its direction times the motion of its upper joint: shift, and turn about the platform's origin.
        slopes = np.concatenate([along, np.cross(arms, along)], -1)
        step = np.linalg.solve(slopes, (wanted - lengths)[..., None])[..., 0]
        position = position + step[:, :3]
        rotation = _turned(rotation, step[:, 3:])
        if np.abs(step).max() < 1e-13:
            break
    far = np.abs(wanted - leg_lengths(values["base"], values["platform"], position, rotation)).max(-1) > 1e-9
    position[far] = np.nan
    return Pose(position, rotation)


def _turned(rotation: Array, vector: Array) -> Array:
    # Cayley's map: a rotation for any vector, equal to the exponential to the second order.
    half = vector / 2
    zero = np.zeros(len(half))
    k = np.stack([zero, -half[:, 2], half[:, 1], half[:, 2], zero, -half[:, 0], -half[:, 1], half[:, 0], zero], -1)
    k = k.reshape(-1, 3, 3)
    return np.asarray(np.linalg.solve(np.eye(3) - k, (np.eye(3) + k) @ rotation))


def five_bar_pose(values: Mapping[str, Array], joints: Array, covariates: Covariates) -> Pose:
    """Where two couplers meet, on the left of the way from the first elbow to the second.

    Blocks, two numbers each: crank, coupler [m], foot `2 x 2` [m], gain [1], offset [rad].
    """
    del covariates
    turn = values["gain"] * joints + values["offset"]
    elbows = values["foot"] + values["crank"][:, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
    way = elbows[:, 1] - elbows[:, 0]
    distance = np.linalg.norm(way, axis=-1)
    first, second = values["coupler"]
    ahead = (distance**2 + first**2 - second**2) / (2 * distance)
    with np.errstate(invalid="ignore"):
        aside = np.sqrt(first**2 - ahead**2)
    unit = way / distance[:, None]
    left = np.stack([-unit[:, 1], unit[:, 0]], -1)
    return Pose(elbows[:, 0] + ahead[:, None] * unit + aside[:, None] * left, None)
