"""What an engineer writes for a Quattro in an hour: the drawing's inverse kinematics, least squares over its numbers.

The plain script fits geometry alone. The fuller one adds the ripple of the motors' gears, what the arms give under the
payload, the way of approach, growth of base, arms, rods and portal, and the plate's belt with its play.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

__all__ = ["Rows", "drawn_inverse", "fitted", "forward", "reach", "send"]

Array = NDArray[np.float64]
AZIMUTH = np.radians([45.0, 135.0, 225.0, 315.0])
PLATE = np.array([[0.07, 0.02], [-0.07, 0.02], [-0.07, -0.02], [0.07, -0.02]])
MOTOR, TEMPERATURE, PLATE_WEIGHT = 33.0, 25.0, 2.8 * 9.81
# A leg: foot [m], azimuth and lean of the axis [rad], arm, rod [m], zero [rad]; then bars, zero, gear, point, stand.
FEET = 0.275 * np.stack([np.cos(AZIMUTH), np.sin(AZIMUTH), 0 * AZIMUTH], -1)
LEGS = np.c_[FEET, AZIMUTH, np.zeros(4), np.full(4, 0.375), np.full(4, 0.825), np.zeros(4)]
DRAWN = np.r_[LEGS.ravel(), 0.05, 0.05, 0.0, 4.0, 0.06, 0.0, -0.03, np.zeros(6)]
SIZES = np.r_[np.tile([2e-4, 2e-4, 2e-4, 1e-3, 1e-3, 2e-4, 2e-4, 2e-3], 4), 1e-4, 1e-4, 2e-3, 4e-3, np.full(3, 5e-4)]
SIZES = np.r_[SIZES, np.full(6, 2e-3)]
# Causes: ripple of each motor's first and second wave (sine, cosine), of an arm's turn, give [rad/(N m)], way, growth
# of base, arms, rods [1/K], portal [m/K], sine and cosine of the flange's turn, half its play.
CAUSES = np.r_[np.full(16, 1e-4), np.full(8, 1e-4), np.full(4, 1e-4), np.full(4, 5e-5), 2e-5, 2e-5, 2e-5, 2e-5]
CAUSES = np.r_[CAUSES, np.full(2, 1e-3), 2e-3]


class Rows(NamedTuple):
    """What is told of rows: temperatures of hall and base [degC], load [N], ways of the motors and of the flange."""

    hall: Array
    base: Array
    load: Array
    way: Array
    turned: Array


def inverse(pose: Array, numbers: Array, rows: Rows | None = None, causes: Array | None = None) -> Array:
    """Angles of the arms at poses of the reflector, `s x 4` by `s x 4`, without what moves the drives."""
    legs, rest = numbers[:32].reshape(4, 8), numbers[32:]
    foot, (azimuth, lean, arm, rod, zero) = legs[:, :3], legs[:, 3:].T
    feet, arms, rods, shift, turn = foot[None], arm[None], rod[None], rest[7:10][None], np.zeros(len(pose))
    if rows is not None and causes is not None:
        hall, base = rows.hall - TEMPERATURE, rows.base - TEMPERATURE
        feet = feet * (1 + causes[32] * base)[:, None, None]
        arms, rods = arm * (1 + causes[33] * hall)[:, None], rod * (1 + causes[34] * hall)[:, None]
        shift = shift + np.stack([0 * hall, 0 * hall, causes[35] * hall], -1)
        turn = causes[36] * np.sin(pose[:, 3]) + causes[37] * np.cos(pose[:, 3]) + causes[38] * rows.turned
    rx, ry, rz = rest[10:]
    place, phi = pose[:, :3] - shift, pose[:, 3] - rz
    place = place - np.cross(np.array([rx, ry, rz]), place)
    c, s = np.cos(phi), np.sin(phi)
    point = np.stack([c * rest[4] - s * rest[5], s * rest[4] + c * rest[5], rest[6] + 0 * c], -1)
    theta = (phi - turn) / rest[3] - rest[2]
    bar = np.array([rest[0], rest[0], -rest[1], -rest[1]])
    swung = np.stack([-np.sin(theta)[:, None] * bar, np.cos(theta)[:, None] * bar, 0 * theta[:, None] * bar], -1)
    way = (place - point)[:, None] + np.c_[PLATE, np.zeros(4)] + swung - feet
    out = np.cos(azimuth) * way[..., 0] + np.sin(azimuth) * way[..., 1]
    along = np.cos(azimuth) * way[..., 1] - np.sin(azimuth) * way[..., 0]
    down = np.sin(lean) * along - np.cos(lean) * way[..., 2]
    level = ((way**2).sum(-1) + arms**2 - rods**2) / (2 * arms)
    return np.asarray(np.arctan2(down, out) - np.arccos(np.clip(level / np.hypot(out, down), -1, 1)) - zero)


def drawn_inverse(pose: Array) -> Array:
    """Joints that the controller computes, `s x 4`."""
    return inverse(pose, DRAWN)


def lever(pose: Array, numbers: Array) -> Array:
    """How far the arms turn for a pose, `s x 4 x 4`: derivatives of the inverse."""
    steps = 1e-5 * np.eye(4)
    slopes = [(inverse(pose + step, numbers) - inverse(pose - step, numbers)) / 2e-5 for step in steps]
    return np.asarray(np.stack(slopes, -1))


def drives(joints: Array, pose: Array, rows: Rows, causes: Array) -> Array:
    """Where the arms are at commands near a pose, `s x 4`."""
    wave = [f(k * joints) for k in (MOTOR, 2 * MOTOR, 1.0) for f in (np.sin, np.cos)]
    moved = joints + sum(a * w for a, w in zip(causes[:24].reshape(6, 4), wave, strict=True))
    up = np.zeros((len(joints), 4, 1))
    up[:, 2, 0] = rows.load - PLATE_WEIGHT
    torque = np.linalg.solve(lever(pose, DRAWN).swapaxes(1, 2), up)[..., 0]
    return np.asarray(moved + causes[24:28] * torque + causes[28:32] * rows.way)


def forward(joints: Array, numbers: Array, near: Array, rows: Rows | None = None, causes: Array | None = None) -> Array:
    """Poses at commands, `s x 4`, by Newton's method from poses near them."""
    at = joints if rows is None or causes is None else drives(joints, near, rows, causes)
    pose = near.copy()
    for _ in range(4):
        off = inverse(pose, numbers, rows, causes) - at
        pose = pose - np.linalg.solve(lever(pose, numbers), off[..., None])[..., 0]
    return pose


def reach(joints: Array) -> Array:
    """Poses of the drawing at joints, `s x 4`, from the middle of the workspace."""
    pose = np.tile([0.06, 0.0, -0.88, 0.0], (len(joints), 1))
    for _ in range(30):
        move = np.linalg.solve(lever(pose, DRAWN), (inverse(pose, DRAWN) - joints)[..., None])[..., 0]
        pose = pose - np.clip(move, -0.1, 0.1)
    return pose


def fitted(joints: Array, places: Array, rows: Rows | None) -> tuple[Array, Array | None]:
    """Numbers, and causes where rows are told: least squares with a ridge of plausible sizes."""
    near, many = reach(joints), len(DRAWN)

    def numbers(u: Array) -> tuple[Array, Array | None]:
        return DRAWN + u[:many] * SIZES, None if rows is None else u[many:] * CAUSES

    def left(u: Array) -> Array:
        found, causes = numbers(u)
        at = forward(joints, found, near, rows, causes)[:, :3]
        return np.asarray(np.r_[(at - places).ravel() / 3e-5, u])

    return numbers(least_squares(left, np.zeros(many + (0 if rows is None else len(CAUSES))), x_scale=1.0).x)


def send(wanted: Array, numbers: Array, rows: Rows | None = None, causes: Array | None = None) -> Array:
    """Commands to wanted poses, `s x 4`."""
    aim = inverse(wanted, numbers, rows, causes)
    if rows is None or causes is None:
        return aim
    joints = aim
    for _ in range(8):
        joints = joints + aim - drives(joints, wanted, rows, causes)
    return joints
