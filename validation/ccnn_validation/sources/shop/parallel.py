"""Parallel machines: a five-bar, a delta with cranks or with rails, and a Stewart platform."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.shop.box import BoxMachine, grown, upright
from ccnn_validation.sources.shop.machine import Array, Errors, Pose

__all__ = ["Delta", "FiveBar", "Stewart"]

_THIRDS = np.deg2rad(np.array([0, 120, 240]))
_NEWTON = 30


class FiveBar(BoxMachine):
    """Two cranks of 0.3 m, 0.24 m apart, and two rods of 0.45 m, in a vertical plane. Errors: crank, rod, x, y."""

    name, joint_units, mass, down = "five_bar", ("rad", "rad"), 3.0, np.array([0, -1.0, 0])
    crank, rod, half = 0.3, 0.45, 0.12
    sizes = MappingProxyType({"crank": (1e-3, (2,)), "rod": (1e-3, (2,)), "x": (6e-4, (2,)), "y": (6e-4, (2,))})
    low, high = np.array([-0.19, 0.25]), np.array([0.19, 0.62])

    @property
    def axes(self) -> str:
        """The plane."""
        return "xy"

    def joints_at(self, places: Array) -> Array:
        """Angles of the cranks, elbows outwards."""
        reach = places[:, None] - np.stack([[-self.half, 0], [self.half, 0]])
        far = np.linalg.norm(reach, axis=-1)
        inner = np.arccos((self.crank**2 + far**2 - self.rod**2) / (2 * self.crank * far))
        return np.asarray(np.arctan2(reach[..., 1], reach[..., 0]) + inner * [1, -1])

    def pose(self, joints: Array, errors: Errors | None = None) -> Pose:
        """Position of the tip: the upper crossing of the two rods' circles; z is 0."""
        errors = errors or {}
        q, none = joints + errors.get("joints", 0), np.zeros(2)
        crank, rod = self.crank + errors.get("crank", none), self.rod + errors.get("rod", none)
        x, y = np.array([-self.half, self.half]) + errors.get("x", 0), none + errors.get("y", 0)
        elbows = np.stack([x + crank * np.cos(q), y + crank * np.sin(q)], -1)
        across = elbows[:, 1] - elbows[:, 0]
        wide = np.linalg.norm(across, axis=1)
        along = (rod[0] ** 2 - rod[1] ** 2 + wide**2) / (2 * wide)
        height = np.sqrt(rod[0] ** 2 - along**2)
        unit = across / wide[:, None]
        normal = np.stack([-unit[:, 1], unit[:, 0]], -1)
        tip = elbows[:, 0] + unit * along[:, None] + normal * height[:, None]
        return grown(np.c_[tip, 0 * wide], errors), upright(len(joints))

    def told(self) -> tuple[str, dict[str, Any]]:
        """By name."""
        return self.name, {"l": self.crank, "L": self.rod, "a": self.half}


class Delta(BoxMachine):
    """Three rods from cranks, or from carriages on vertical rails. Errors: base, rod, angle, and crank."""

    mass = 1.5

    def __init__(self, rails: bool) -> None:
        self.rails, self.name = rails, "delta_linear" if rails else "delta"
        self.joint_units = ("m" if rails else "rad",) * 3
        self.base, self.crank, self.platform, self.rod = (0.32, 0.0, 0.06, 0.6) if rails else (0.2, 0.3, 0.05, 0.7)
        own = {} if rails else {"crank": (6e-4, (3,))}
        self.sizes = {name: (8e-4, (3,)) for name in ("base", "rod", "angle")} | own
        below, above = (0, 0.3) if rails else (-0.6, -0.4)
        self.low, self.high = np.array([-0.15, -0.15, below]), np.array([0.15, 0.15, above])

    def _elbows(self, q: Array, errors: Errors) -> Array:
        """Upper ends of the rods, moved inwards by the platform's radius, `s x 3 x 3`."""
        angle = _THIRDS + errors.get("angle", 0)
        base, crank = self.base + errors.get("base", 0) - self.platform, self.crank + errors.get("crank", 0)
        out, up = (base + 0 * q, q) if self.rails else (base + crank * np.cos(q), -crank * np.sin(q))
        return np.stack([out * np.cos(angle), out * np.sin(angle), up], -1)

    def pose(self, joints: Array, errors: Errors | None = None) -> Pose:
        """Position of the platform, by Newton's method on the rods' lengths."""
        errors = errors or {}
        elbows = self._elbows(joints + errors.get("joints", 0), errors)
        length = self.rod + errors.get("rod", np.zeros(3))
        place = np.tile([0, 0, 0.15 if self.rails else -0.5], (len(joints), 1))
        for _ in range(_NEWTON):
            reach = place[:, None] - elbows
            left = ((reach**2).sum(-1) - length**2)[..., None]
            place = place - np.linalg.solve(2 * reach, left)[..., 0]
        return grown(place, errors), upright(len(joints))

    def joints_at(self, places: Array) -> Array:
        """Carriages in closed form; cranks by Newton's method on the rods' lengths."""
        if self.rails:
            reach = places[:, None] - self._elbows(np.zeros((len(places), 3)), {})
            return np.asarray(places[:, 2:] + np.sqrt(self.rod**2 - (reach[..., :2] ** 2).sum(-1)))

        def left(q: Array) -> Array:
            return np.asarray(((places[:, None] - self._elbows(q, {})) ** 2).sum(-1) - self.rod**2)

        q = np.full((len(places), 3), -0.1)
        for _ in range(_NEWTON):
            q = q - left(q) / ((left(q + 1e-6) - left(q - 1e-6)) / 2e-6)
        return q

    def told(self) -> tuple[str, dict[str, Any]]:
        """By name."""
        keys = {"base": self.base, "platform": self.platform, "rod": self.rod}
        return self.name, keys if self.rails else keys | {"crank": self.crank}


class Stewart(BoxMachine):
    """Six legs between two rings. Errors: base and platform, the places of their joints."""

    name, joint_units, mass, turns = "stewart", ("m",) * 6, 25.0, True
    low, high = np.array([-0.1, -0.1, 0.46, -0.22, -0.22, -0.22]), np.array([0.1, 0.1, 0.64, 0.22, 0.22, 0.22])
    sizes = MappingProxyType({"base": (6e-4, (6, 3)), "platform": (5e-4, (6, 3))})

    def __init__(self) -> None:
        _, left, right = _THIRDS
        self.base = _ring(0.45, [0.3, left - 0.3, left + 0.3, right - 0.3, right + 0.3, -0.3])
        corners = np.deg2rad(60), np.pi, np.deg2rad(300)
        self.platform = _ring(0.25, [corner + side for corner in corners for side in (-0.4, 0.4)])

    def _legs(self, pose: Pose, base: Array, platform: Array) -> tuple[Array, Array]:
        """Legs and the platform's joints from its centre, `s x 6 x 3` each."""
        turned = (pose[1] @ platform.T).transpose(0, 2, 1)
        return pose[0][:, None] + turned - base, turned

    def joints_at(self, places: Array) -> Array:
        """Lengths of the legs."""
        pose = places[:, :3], Rotation.from_rotvec(places[:, 3:]).as_matrix()
        return np.asarray(np.linalg.norm(self._legs(pose, self.base, self.platform)[0], axis=-1))

    def pose(self, joints: Array, errors: Errors | None = None) -> Pose:
        """Pose of the platform, by Newton's method on the lengths of the legs."""
        errors = errors or {}
        q = joints + errors.get("joints", 0)
        base, platform = self.base + errors.get("base", 0), self.platform + errors.get("platform", 0)
        place, rotation = np.tile([0, 0, 0.55], (len(q), 1)), np.tile(np.eye(3), (len(q), 1, 1))
        for _ in range(25):
            legs, turned = self._legs((place, rotation), base, platform)
            length = np.linalg.norm(legs, axis=-1)
            unit = legs / length[..., None]
            slope = np.concatenate([unit, np.cross(turned, unit)], -1)
            step = np.linalg.solve(slope, (q - length)[..., None])[..., 0]
            place, rotation = place + step[:, :3], Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
        return grown(place, errors), rotation

    def told(self) -> tuple[str, dict[str, Any]]:
        """By name."""
        rings = {"base_radius": 0.45, "platform_radius": 0.25, "base_spread": 0.3, "platform_spread": 0.4}
        return self.name, rings | {"height": 0.55}


def _ring(radius: float, angles: list[float]) -> Array:
    at = np.array(angles)
    return np.asarray(radius * np.stack([np.cos(at), np.sin(at), 0 * at], -1))
