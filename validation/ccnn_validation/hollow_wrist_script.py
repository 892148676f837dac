"""What an engineer writes in SciPy for the robot with the hollow wrist: its data sheet and least squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.hollow_wrist_robot import (
    ALPHA,
    CENTRES,
    GEARS,
    HIGH,
    LOW,
    MASSES,
    POINTS,
    THETA,
    TOOLS,
    A,
    D,
    frames,
    sheet_frames,
    torques,
)  # fmt: skip

Array = NDArray[np.float64]
DOWN = np.array([0, 0, -1.0])
HOLDS = np.array([90.0, 110, 70, 9, 7, 5])
# Numbers, and how far each may be off; the plain script has the first six groups alone.
GROUPS = {
    "a": (6, 5e-4), "d": (6, 5e-4), "alpha": (6, 5e-4), "theta": (6, 1e-3), "lean": (1, 3e-4), "soft": (6, 1.0),
    "coupling": (3, 3e-4), "gears": (24, 6e-5), "meshes": (8, 1e-4), "lost": (6, 2e-4), "growth": (2, 1.5e-5),
    "bends": (6, 8e-6), "tilt": (1, 1e-6), "drift": (6, 4e-5), "base": (6, 1.0), "points": (6, 1e-3),
}  # fmt: skip
FULL = ("coupling", "gears", "meshes", "lost", "growth", "bends", "tilt", "drift")
SOFT = 1 / np.array([8e5, 1e6, 6e5, 1e5, 6e4, 4e4])
Told = tuple[Array, Array, Array, Array, Array, float]
"""Tool in each row, warmth beyond 20 deg C, direction of each motor, time as a share of the session; ratios of shafts,
and by how much friction is held above `HOLDS`."""


def split(x: Array) -> dict[str, Array]:
    """Numbers by the name of their group."""
    ends = np.cumsum([count for count, _ in GROUPS.values()])
    return dict(zip(GROUPS, np.split(x, ends[:-1]), strict=True))


def flange(x: Array, joints: Array, told: Told) -> Array:
    """Frames of the last link in the base, `s x 4 x 4`."""
    n, (kind, warmth, direction, _, given, more) = split(x), told
    shafts = given.copy()
    shafts[[1, 2, 2], [0, 0, 1]] += n["coupling"]
    inverse, motors = np.linalg.inv(shafts), joints.copy()
    motors[:, 3:] = joints[:, 3:] @ given.T
    grown = warmth[:, None] * n["growth"][[0, 0, 1, 1, 1, 1]] + 1
    links = (A + n["a"]) * grown, np.radians(ALPHA) + n["alpha"], (D + n["d"]) * grown, np.radians(THETA) + n["theta"]
    mass = np.array([TOOLS[int(k)][0] for k in kind])
    centre = np.array([TOOLS[int(k)][1] for k in kind], dtype=float)
    tau = torques(sheet_frames(joints), MASSES, CENTRES, mass, centre, DOWN)
    load, waves = tau.copy(), n["gears"].reshape(4, 6)
    load[:, 3:] = tau[:, 3:] @ inverse
    turned = motors + SOFT * (1 + n["soft"]) * load
    for k in (0, 1):
        turns = (k + 1) * GEARS * motors
        turned = turned + waves[2 * k] * np.sin(turns) + waves[2 * k + 1] * np.cos(turns)
    turned = turned + n["lost"] / 2 * np.tanh((load / more - HOLDS * direction) / (0.3 * HOLDS))
    true = turned + n["bends"] * warmth[:, None]
    true[:, 3:] = turned[:, 3:] @ inverse.T + n["bends"][3:] * warmth[:, None]
    for k, mesh in enumerate(n["meshes"].reshape(2, 4)):
        out, rolled = joints[:, 4 + k], motors[:, 4 + k] - motors[:, 3]
        true[:, 4 + k] += np.stack([np.sin(out), np.cos(out), np.sin(rolled), np.cos(rolled)], -1) @ mesh
    chain = frames(true, *links, float(n["lean"][0]))
    heavy, at = np.r_[MASSES[3:].sum(), mass.mean()], chain[:, 3, :3, 3]
    moment = np.cross(chain[:, 6, :3, 3] - at, 9.81 * DOWN) * (0.5 * heavy[0] + mass[:, None])
    turn = n["tilt"][0] * (moment - chain[:, 3, :3, 2] * (moment * chain[:, 3, :3, 2]).sum(-1, keepdims=True))
    last = chain[:, 6].copy()
    last[:, :3, 3] += np.cross(turn, last[:, :3, 3] - at)
    last[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ last[:, :3, :3]
    return last


def seen_by(x: Array, joints: Array, told: Told, turn: Rotation) -> Array:
    """Where the tracker sees the reflector, `s x 3` [m]; `turn`: rough orientation of the robot in its frame."""
    n, last = split(x), flange(x, joints, told)
    points = POINTS[:2] + n["points"].reshape(2, 3)
    at = (last[:, :3, :3] @ points[told[0]][..., None])[..., 0] + last[:, :3, 3]
    seen = (Rotation.from_rotvec(n["base"][3:] * 1e-2) * turn).apply(at) + n["base"][:3]
    return np.asarray(seen + told[3][:, None] * (n["drift"][:3] + np.cross(n["drift"][3:], seen) / 3))


def fit(joints: Array, told: Told, seen: Array, full: bool) -> tuple[Array, Array]:
    """Numbers of the script, and what it leaves in the robot's base, `s x 3` [m]."""
    last = sheet_frames(joints)[:, 6]
    at = (last[:, :3, :3] @ POINTS[told[0]][..., None])[..., 0] + last[:, :3, 3]
    turn, _ = Rotation.align_vectors(seen - seen.mean(0), at - at.mean(0))
    size = np.concatenate([np.full(k, s if full or name not in FULL else 0.0) for name, (k, s) in GROUPS.items()])
    start, free = np.zeros(len(size)), np.flatnonzero(size)
    names = np.concatenate([[name] * k for name, (k, _) in GROUPS.items()])
    start[np.flatnonzero(names == "base")[:3]] = seen.mean(0) - turn.apply(at.mean(0))
    noise, loose = (4e-5 if full else 1.5e-4), np.where(names[free] == "base", 1e-3, 1.0)

    def residuals(u: Array) -> Array:
        x = start.copy()
        x[free] += u * size[free]
        return np.asarray(np.r_[((seen_by(x, joints, told, turn) - seen) / noise).ravel(), u * loose])

    found = least_squares(residuals, np.zeros(len(free)), method="trf", x_scale="jac", max_nfev=60).x
    x = start.copy()
    x[free] += found * size[free]
    return x, (Rotation.from_rotvec(split(x)["base"][3:] * 1e-2) * turn).inv().apply(
        seen - seen_by(x, joints, told, turn)
    )


def corrected(wanted: Array, told: Told, x: Array, more: Array | float = 0.0) -> Array:
    """Commands at which the script's flange is where the data sheet's is, damped; `more`: what else moves it [m]."""
    goal = sheet_frames(wanted)[:, 6]
    sent, step, size = wanted.copy(), 1e-6, np.r_[np.ones(3), np.full(3, 0.2)]

    def off(joints: Array) -> Array:
        now = flange(x, joints, told)
        turn = Rotation.from_matrix(goal[:, :3, :3] @ now[:, :3, :3].swapaxes(1, 2)).as_rotvec()
        lever = (goal[:, :3, :3] @ [0, 0, 0.27]) - (now[:, :3, :3] @ [0, 0, 0.27])
        return np.asarray(np.c_[goal[:, :3, 3] - now[:, :3, 3] + lever - more, turn] * size)

    for _ in range(6):
        lack = off(sent)
        slope = np.stack([(lack - off(sent + step * way)) / step for way in np.eye(6)], -1)
        square = slope.swapaxes(1, 2) @ slope + 1e-7 * np.eye(6)
        sent = sent + np.linalg.solve(square, slope.swapaxes(1, 2) @ lack[..., None])[..., 0]
    return sent


def by_process(joints: Array, left: Array, wanted: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over the joints, at those wanted, `s x 3` [m]."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(6, 2.0), (0.3, 1e3)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = (HIGH - LOW) / 4
    rows, new = joints / scale, wanted / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)
