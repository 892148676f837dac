"""The Stewart platform in MuJoCo: six legs of a universal joint and a slide, each tied to a free platform."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build, document, drive_joints, inertia, placed, platform_joints
from ccnn_validation.sources.multibody.machine import Machine

__all__ = ["stewart"]


def stewart(base: float = 0.5, platform: float = 0.3, height: float = 0.6) -> Machine:
    """The machine with joints on circles of these radii, and its middle at this height [m]."""
    spread = math.radians(15.0)
    pair = np.radians(120.0) * np.array([0, 1, 1, 2, 2, 0]) + spread * np.array([1, -1, 1, -1, 1, -1])
    between = np.radians(60.0 + 120.0 * np.array([0, 0, 1, 1, 2, 2])) + spread * np.array([-1, 1, -1, 1, -1, 1])
    feet = base * np.stack([np.cos(pair), np.sin(pair), 0 * pair], -1)
    heads = platform * np.stack([np.cos(between), np.sin(between), 0 * pair], -1)
    home = heads + np.array([0.0, 0.0, height]) - feet
    # Legs are drawn along their direction at home, so that their universal joints stay far from singular.
    frames = [
        Rotation.align_vectors(h[None], [[0.0, 0.0, 1.0]])[0] for h in home / np.linalg.norm(home, axis=1)[:, None]
    ]
    lengths: dict[str, float] = {}
    for i in range(6):
        lengths |= {f"B{i + 1}{c}": float(v) for c, v in zip("xyz", feet[i], strict=True)}
        lengths |= {f"P{i + 1}{c}": float(v) for c, v in zip("xyz", heads[i], strict=True)}

    def model(build: Build) -> str:
        now = {**lengths, **build.lengths}
        legs = "".join(_leg(i, [now[f"B{i + 1}{c}"] for c in "xyz"], frames[i], build) for i in range(6))
        sites = "".join(f'<site name="head{i + 1}" {placed([now[f"P{i + 1}{c}"] for c in "xyz"])}/>' for i in range(6))
        carried, mass = inertia(40.0, (0.0, 0.0, 0.03), build)
        extra = f"<body>{inertia(build.payload, (0, 0, 0), build)[1]}</body>" if build.payload else ""
        tool = placed(build.tool[:3], Rotation.from_rotvec(build.tool[3:]))
        bodies = f'{legs}<body {carried}>{mass}{platform_joints()}{sites}<site name="tool" {tool}/>{extra}</body>'
        return document(bodies, [(f"end{i + 1}", f"head{i + 1}") for i in range(6)], 6, build, (0.0, 0.0, -1.0))

    def start(joints: Array, pose: Array) -> Mapping[str, Array]:
        turn = Rotation.from_rotvec(pose[:, 3:])
        bend = turn.as_euler("XYZ")
        state = {f"p{c}": pose[:, i] for i, c in enumerate("xyz")} | {f"r{c}": bend[:, i] for i, c in enumerate("xyz")}
        for i in range(6):
            leg = frames[i].inv().apply(pose[:, :3] + turn.apply(heads[i]) - feet[i])
            leg /= np.linalg.norm(leg, axis=1, keepdims=True)
            # Rx(a) Ry(b) z = (sin b, -sin a cos b, cos a cos b).
            state[f"u{i + 1}"], state[f"v{i + 1}"] = np.arctan2(-leg[:, 1], leg[:, 2]), np.arcsin(leg[:, 0])
            state[f"q{i + 1}"] = joints[:, i]
        return state

    return Machine(
        name="stewart",
        mechanism="stewart",
        keys={"base_radius": base, "platform_radius": platform, "height": height},
        units=("m",) * 6,
        pose=("x", "y", "z", "rx", "ry", "rz"),
        low=None,
        high=None,
        lengths=lengths,
        model=model,
        start=start,
        stiff=np.full(6, 2e6),
        reach=height,
    )


def _leg(leg: int, foot: list[float], frame: Rotation, build: Build) -> str:
    """A leg: universal joint at its foot, slide, and the end that the platform holds."""
    carried, lower = inertia(2.0, (0.0, 0.0, 0.15), build)
    _, rod = inertia(1.0, (0.0, 0.0, -0.15), build)
    return (
        f"<body {placed(foot, frame)} {carried}>{lower}"
        f'<joint name="u{leg + 1}" axis="1 0 0"/><joint name="v{leg + 1}" axis="0 1 0"/>'
        f"<body {carried}>{rod}{drive_joints(leg, (0.0, 0.0, 1.0), build, sliding=True)}"
        f'<site name="end{leg + 1}"/></body></body>'
    )
