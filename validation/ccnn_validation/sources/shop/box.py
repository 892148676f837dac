"""Machines whose places are planned in a box, and the simplest of them: a gantry."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from ccnn_validation.sources.shop.machine import GRAVITY, Array, Errors, Machine, Pose

__all__ = ["BoxMachine", "Gantry", "grown", "upright"]


class BoxMachine(Machine):
    """A machine with one moving mass [kg], and joints in closed form (or by Newton's method) from the pose."""

    mass: float

    @abstractmethod
    def joints_at(self, places: Array) -> Array:
        """Joints of poses (position [m], and the rotation vector [rad] where there is one)."""

    def energy(self, joints: Array) -> Array:
        """Potential energy of the moving mass [J]."""
        return np.asarray(self.mass * GRAVITY * self.pose(joints)[0] @ -self.down)

    def plan(self, rows: int, rng: np.random.Generator, kind: str) -> Array:
        """Joints of places in the box: anywhere, on a grid (the first three of its sides), or 30 places five times."""
        sides = len(self.low)
        shares = rng.random((rows, sides))
        if kind == "grid":
            flat = min(sides, 3)
            ticks = int(np.ceil(rows ** (1 / flat)))
            grid = np.stack(np.meshgrid(*[(np.arange(ticks) + 0.5) / ticks] * flat), -1).reshape(-1, flat)
            grid = grid[rng.permutation(len(grid))][:rows]
            shares = shares[: len(grid)]
            shares[:, :flat] = grid
        if kind == "cube":
            places = rng.random((30, sides))
            shares = np.vstack([places[rng.permutation(30)] for _ in range(5)])
        return self.joints_at(self.low + (self.high - self.low) * shares)


def grown(place: Array, errors: Errors) -> Array:
    """Positions of a machine that has grown as a whole."""
    return np.asarray(place * (1 + errors.get("growth", np.zeros(len(place))))[:, None])


def upright(rows: int) -> Array:
    """Rotations of a platform that keeps its orientation."""
    return np.broadcast_to(np.eye(3), (rows, 3, 3))


class Gantry(BoxMachine):
    """Three axes at right angles, told as a URDF; where its base stands is unknown to the diagnosis."""

    name, frames, joint_units, mass = "gantry", "unknown", ("m", "m", "m"), 40.0
    low, high = np.array([0, 0, -0.6]), np.array([1.5, 1, 0])

    def joints_at(self, places: Array) -> Array:
        """The axes stand at the place itself."""
        return places

    def pose(self, joints: Array, errors: Errors | None = None) -> Pose:
        """Position of the tip [m]."""
        errors = errors or {}
        tip = joints + errors.get("joints", 0) + [0.1, 0, 1.3]
        return grown(tip, errors), upright(len(joints))

    def told(self) -> tuple[str, dict[str, Any]]:
        """A URDF [m]."""
        return (
            '<robot name="gantry"><link name="base"/><link name="bx"/><link name="by"/><link name="bz"/>'
            '<link name="tip"/>\n'
            + _axis("X", "base", "bx", "0 0 1.2", "1 0 0", "0", "1.5")
            + _axis("Y", "bx", "by", "0 0 0.3", "0 1 0", "0", "1")
            + _axis("Z", "by", "bz", "0.1 0 0", "0 0 1", "-0.6", "0")
            + '<joint name="T" type="fixed"><parent link="bz"/><child link="tip"/>'
            '<origin xyz="0 0 -0.2" rpy="0 0 0"/></joint></robot>\n'
        ), {}


def _axis(name: str, parent: str, child: str, origin: str, axis: str, low: str, high: str) -> str:
    return (
        f'<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}" rpy="0 0 0"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>\n'
    )
