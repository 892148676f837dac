"""A made-up arm and what instruments on it show, in numpy: no formula of the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

A = np.array([0, -0.61, -0.57, 0, 0, 0])
D = np.array([0.13, 0, 0, 0.16, 0.12, 0.09])
ALPHA = np.array([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0])
TOOL = np.array([0.05, -0.02, 0.12])
LOW, HIGH = np.array([-2, -2.2, 0.3, -2.5, -2.2, -3]), np.array([2, -0.6, 2.2, 0.5, 2.2, 3])


def turn(vector: list[float]) -> Array:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    v = np.array(vector, dtype=float)
    angle = np.linalg.norm(v)
    k = v / angle
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


class Arm:
    """Six joints; lengths off by half a millimetre, angles by one and two milliradians; none off without a seed."""

    def __init__(self, seed: int | None) -> None:
        rng = np.random.default_rng(seed)
        a, d, alpha, self.theta = (rng.normal(0, sd, 6) * (seed is not None) for sd in (5e-4, 5e-4, 1e-3, 2e-3))
        self.a, self.d, self.alpha = A + a, D + d, ALPHA + alpha

    def flange(self, q: Array) -> tuple[Array, Array]:
        """Rotation and place of the flange with joints `... x 6`."""
        rotation, place = np.eye(3), np.zeros(3)
        for a, d, alpha, angle in zip(self.a, self.d, self.alpha, np.moveaxis(q + self.theta, -1, 0), strict=True):
            c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
            one = np.ones_like(c)
            link = np.array([[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0 * one, sa * one, ca * one]])
            place = place + np.einsum("...ij,j...->...i", rotation, np.array([a * c, a * s, d * one]))
            rotation = rotation @ np.moveaxis(link, (0, 1), (-2, -1))
        return rotation, place

    def tip(self, q: Array) -> Array:
        rotation, place = self.flange(q)
        return np.asarray(place + rotation @ TOOL)


def joints(count: int, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(LOW, HIGH, (count, 6))


def arm_file(folder: Path, frames: bool, name: str = "arm.yaml", base: str = "identity") -> Path:
    """The nominal arm, frames known or not."""
    tool = "unknown" if frames else f"[{', '.join(map(str, TOOL))}, 0, 0, 0]"
    text = (
        "robot: own\ndof: 6\nconvention: standard Denavit-Hartenberg\nunits: {length: m, angle: rad}\n"
        f"a: {A.tolist()}\nalpha: {ALPHA.tolist()}\nd: {D.tolist()}\ntheta: [0, 0, 0, 0, 0, 0]\n"
        f"base_frame: {'unknown' if frames else base}\ntool_frame: {tool}\n"
    )
    (folder / name).write_text(text)
    return folder / name


def write(path: Path, q: Array, columns: dict[str, Array], prefix: str = "") -> Path:
    names = [f"{prefix}q{i + 1}[rad]" for i in range(6)]
    table = np.column_stack([q, *columns.values()])
    np.savetxt(path, table, delimiter=",", header=",".join([*names, *columns]), comments="", fmt="%.10g")
    return path


LENS = {"fx": 905.0, "fy": 903.0, "cx": 646.0, "cy": 362.0, "k1": -0.08, "k2": 0.03}
MOUNT = (turn([0.1, -0.05, 0.3]), np.array([0.03, 0.05, 0.08]))
BOARD = (turn([0.02, 0.01, 0.4]), np.array([-0.7, -0.15, 0.05]))
CORNERS = np.array([[0.03 * i, 0.03 * j, 0.0] for i in range(5) for j in range(4)])


def images(arm: Arm, count: int, seed: int, noise: float, off: Array | float = 0.0) -> tuple[Array, dict[str, Array]]:
    """A camera on the flange over a board, `noise` in pixels; off: of the corners from where they are said to be."""
    rng = np.random.default_rng(seed)
    found: list[list[float]] = []
    taken = 0
    while taken < count:
        q = np.array([0, -1.2, 1.6, -1.9, -1.57, 0]) + rng.normal(0, 0.35, 6)
        rotation, place = arm.flange(q)
        turned, there = rotation @ MOUNT[0], place + rotation @ MOUNT[1]
        seen = (BOARD[1] + (CORNERS + off) @ BOARD[0].T - there) @ turned
        ratio = seen[:, :2] / seen[:, 2:]
        square = (ratio**2).sum(1)
        wide = 1 + LENS["k1"] * square + LENS["k2"] * square**2
        pixels = ratio * wide[:, None] * [LENS["fx"], LENS["fy"]] + [LENS["cx"], LENS["cy"]]
        if (seen[:, 2] < 0.15).any() or (pixels < 0).any() or (pixels > [1280, 720]).any():
            continue
        shown = pixels + rng.normal(0, noise, pixels.shape)
        found += [[*q, *corner, *pixel] for corner, pixel in zip(CORNERS, shown, strict=True)]
        taken += 1
    rows = np.array(found)
    names = ("board_x[m]", "board_y[m]", "board_z[m]", "u[px]", "v[px]")
    return rows[:, :6], {name: rows[:, 6 + i] for i, name in enumerate(names)}


def camera_pose(arm: Arm, q: Array) -> Array:
    """Place and rotation vector of the camera in the board's frame, `6`."""
    rotation, place = arm.flange(q)
    turned, there = rotation @ MOUNT[0], place + rotation @ MOUNT[1]
    vector = Rotation.from_matrix(BOARD[0].T @ turned).as_rotvec()
    return np.concatenate([BOARD[0].T @ (there - BOARD[1]), vector])
