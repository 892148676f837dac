"""Arms by standard Denavit-Hartenberg tables: a painting robot, an arm of seven joints, a SCARA and a planar arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.shop.machine import GRAVITY, Array, Errors, Machine, Pose, jacobian

__all__ = ["ARMS", "Arm", "arm"]

_RADIAN = 0.3
"""A radian counts as so many metres where position and orientation are weighed together."""
_WEIGHTS = np.array([1, 1, 1, _RADIAN, _RADIAN, _RADIAN])[:, None]


def _about(axis: str, angles: Array) -> Array:
    return np.asarray(Rotation.from_euler(axis, angles[:, None]).as_matrix())


def _transform(rotation: Array, place: Array) -> Array:
    found = np.zeros((len(place), 4, 4))
    found[:, :3, :3], found[:, :3, 3], found[:, 3, 3] = rotation, place, 1
    return found


@dataclass
class _Table:
    """A row of the table of arms: lengths [m], angles [rad], joints' range, and masses of the links [kg].

    The last mass is counted twice: with its link, and as a tool at the tip.
    """

    a: Any
    alpha: Any
    d: Any
    theta: Any
    joints: str
    low: Any
    high: Any
    mass: Any
    tool: Any


class Arm(Machine):
    """Rz(q + theta) Tz(d) Tx(a) Rx(alpha) for each joint; a prismatic joint adds q to d. Errors: a, alpha, d."""

    turns = True

    def __init__(self, name: str, table: _Table, frames: str) -> None:
        self.name, self.frames, self.joints = name, frames, table.joints
        self.joint_units = tuple("rad" if kind == "R" else "m" for kind in table.joints)
        self.a, self.alpha, self.d, self.theta, self.low, self.high, self.mass, self.tool = (
            np.array(values, float)
            for values in (
                *(table.a, table.alpha, table.d, table.theta),
                *(table.low, table.high, table.mass, table.tool),
            )
        )

    def pose(self, joints: Array, errors: Errors | None = None) -> Pose:
        """Pose of the tool; errors of a and d [m], of alpha [rad]; growth `s x n` of each link."""
        return self._links(joints, errors or {})[:2]

    def _links(self, joints: Array, errors: Errors) -> tuple[Array, Array, list[Array]]:
        """Pose of the tool, and the middle of each link (of a prismatic one its end)."""
        rows = len(joints)
        growth = 1 + errors.get("growth", np.zeros((rows, self.count)))
        q = joints + errors.get("joints", 0)
        a, d = (self.a + errors.get("a", 0)) * growth, (self.d + errors.get("d", 0)) * growth
        alpha = np.broadcast_to(self.alpha + errors.get("alpha", 0), (rows, self.count))
        found: Array = np.broadcast_to(np.eye(4), (rows, 4, 4))
        middles, zero = [], np.zeros(rows)
        for i, kind in enumerate(self.joints):
            turns, before = kind == "R", found[:, :3, 3]
            angle = self.theta[i] + (q[:, i] if turns else zero)
            offset = d[:, i] + (0 if turns else q[:, i] * growth[:, i])
            screw = _transform(_about("z", angle), np.stack([zero, zero, offset], -1))
            found = found @ screw @ _transform(_about("x", alpha[:, i]), np.stack([a[:, i], zero, zero], -1))
            middles.append((before + found[:, :3, 3]) / 2 if turns else found[:, :3, 3])
        found = found @ _transform(np.eye(3), self.tool[None])
        return found[:, :3, 3], found[:, :3, :3], middles

    def energy(self, joints: Array) -> Array:
        """Potential energy of the links, each at its middle, and of the tool [J]."""
        tip, _, middles = self._links(joints, {})
        links = sum(m * GRAVITY * middle[:, 2] for m, middle in zip(self.mass, middles, strict=True))
        return np.asarray(links + self.mass[-1] * GRAVITY * tip[:, 2])

    def plan(self, rows: int, rng: np.random.Generator, kind: str) -> Array:
        """Joints of a cube, if the arm reaches it, else anywhere but near a singularity."""
        if kind == "cube" and len(places := self._cube(rng)) >= 18:
            return np.vstack([places[rng.permutation(len(places))] for _ in range(5)])
        joints = self.low + (self.high - self.low) * rng.random((4 * rows, self.count))
        all_six = jacobian(self, joints)
        condition = np.linalg.cond(all_six[:, :2] if self.count == 3 else all_six * _WEIGHTS)
        return np.asarray(joints[np.argsort(condition > 60, kind="stable")][:rows])

    def _cube(self, rng: np.random.Generator) -> Array:
        """Joints of the reachable places among the 27 of a cube (flat for few joints), the orientation kept."""
        middle = self.low + (self.high - self.low) * rng.uniform(0.35, 0.65, self.count)
        place, rotation = self.pose(np.clip(middle, self.low, self.high)[None])
        half = 0.22 * np.linalg.norm(self.a) + 0.12 * np.abs(self.d).sum()
        corners = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(-1, 3)
        wanted = place + half * corners * ([1, 1, 0.5] if self.count > 4 else [1, 1, 0.15])
        joints = np.repeat(np.clip(middle, self.low, self.high)[None], len(wanted), 0)
        for _ in range(60):
            at, turned = self.pose(joints)
            turn = Rotation.from_matrix(rotation @ turned.transpose(0, 2, 1)).as_rotvec()
            left = np.hstack([wanted - at, _RADIAN * turn])[..., None]
            slope = jacobian(self, joints) * _WEIGHTS
            across = slope.transpose(0, 2, 1)
            step = np.linalg.solve(across @ slope + 1e-6 * np.eye(self.count), across @ left)[..., 0]
            joints = joints + np.clip(step, -0.15, 0.15)
        reached = np.linalg.norm(wanted - self.pose(joints)[0], axis=1) < 3e-3
        return np.asarray(joints[reached & (np.abs(joints) < 3.1).all(1)])

    def told(self) -> tuple[str, dict[str, Any]]:
        """The table as YAML [mm, rad]."""
        a, d, tool = ((1e3 * values).tolist() for values in (self.a, self.d, self.tool))
        kinds = ", ".join("revolute" if kind == "R" else "prismatic" for kind in self.joints)
        return (
            f"robot: {self.name}\ndof: {self.count}\nconvention: standard Denavit-Hartenberg\n"
            f"units: {{length: mm, angle: rad}}\na: {a}\nalpha: {self.alpha.tolist()}\nd: {d}\n"
            f"theta: {self.theta.tolist()}\njoint_types: [{kinds}]\nbase_frame: {self.frames}\n"
            f"tool_frame: {'unknown' if self.frames == 'unknown' else [*tool, 0, 0, 0]}\n"
        ), {}


_P, _H, _T = np.pi, np.pi / 2, np.deg2rad(60)
ARMS = {
    "painter6": _Table(
        *([0.35, 1.2, 0.1, 0, 0, 0], [-_H, 0, -_H, _T, -_T, 0], [0.8, 0, 0, 1.4, 0.17, 0.15], [0, -_H, 0, 0, 0, 0]),
        *("RRRRRR", [-1.3, -0.6, -0.7, -2.6, -2.6, -2.8], [1.3, 0.9, 0.5, 2.6, 2.6, 2.8]),
        *([0, 120, 80, 30, 10, 15], (0.05, 0, 0.2)),
    ),
    "arm7": _Table(
        *([0] * 7, [-_H, _H, _H, -_H, -_H, _H, 0], [0.34, 0, 0.4, 0, 0.4, 0, 0.126], [0] * 7, "R" * 7),
        *([-2.2, -1.2, -1.5, -1.9, -2.2, -1.8, -2.8], [2.2, 1.2, 1.5, -0.4, 2.2, -0.4, 2.8]),
        *([0, 4, 4, 3, 3, 2, 3], (0.03, 0.02, 0.08)),
    ),
    "scara": _Table(
        *([0.325, 0.275, 0, 0], [0, _P, 0, 0], [0.38, 0, 0, 0.02], [0] * 4, "RRPR"),
        *([-2, 0.4, 0.02, -3], [2, 2.3, 0.18, 3], [0, 0, 0, 3], (0.04, 0.0, 0.06)),
    ),
    "planar3r": _Table(
        *([0.4, 0.3, 0.15], [0] * 3, [0.1, 0.03, 0.02], [0] * 3, "RRR"),
        *([-1.5, 0.4, -1.6], [1.5, 2.2, 1.6], [0, 0, 0], (0, 0, 0)),
    ),
}


def arm(name: str, frames: str) -> Arm:
    """The arm of that name, its base and tool frame told (`identity`) or `unknown`."""
    return Arm(name, ARMS[name], frames)
