"""The delta robot in MuJoCo: three cranks, six rods on universal joints, and a platform that is free to turn."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build, document, drive_joints, inertia, placed, platform_joints
from ccnn_validation.sources.multibody.machine import Machine

__all__ = ["delta"]

# Half the distance of the two rods of a parallelogram [m].
_HALF = 0.04


def delta(base: float = 0.2, crank: float = 0.25, platform: float = 0.05, rod: float = 0.55) -> Machine:
    """The machine with these radii and lengths [m]."""
    angles = np.radians([0.0, 120.0, 240.0])
    lengths: dict[str, float] = {}
    for i in range(3):
        lengths |= {f"base{i + 1}": base, f"angle{i + 1}": float(angles[i]), f"crank{i + 1}": crank}
        lengths |= {f"platform{i + 1}": platform, f"rod{i + 1}": rod}

    def model(build: Build) -> str:
        now = {**lengths, **build.lengths}
        legs = "".join(_leg(i, now, build) for i in range(3))
        sites, loops = "", []
        for i in range(3):
            turn = Rotation.from_rotvec([0.0, 0.0, now[f"angle{i + 1}"]])
            for side, aside in (("a", _HALF), ("b", -_HALF)):
                sites += f'<site name="head{i + 1}{side}" {placed(turn.apply([now[f"platform{i + 1}"], aside, 0.0]))}/>'
                loops.append((f"end{i + 1}{side}", f"head{i + 1}{side}"))
        carried, mass = inertia(2.0, (0.0, 0.0, 0.0), build)
        extra = f"<body>{inertia(build.payload, (0, 0, 0), build)[1]}</body>" if build.payload else ""
        bodies = f'{legs}<body {carried}>{mass}{platform_joints()}{sites}<site name="tool"/>{extra}</body>'
        return document(bodies, loops, 3, build, (0.0, 0.0, -1.0))

    def start(joints: Array, pose: Array) -> Mapping[str, Array]:
        state = {f"p{c}": pose[:, i] for i, c in enumerate("xyz")}
        for i, angle in enumerate(angles):
            q = joints[:, i]
            place = Rotation.from_rotvec([0.0, 0.0, -angle]).apply(pose) + np.array([platform, 0.0, 0.0])
            end = np.stack([base + crank * np.cos(q), 0 * q, -crank * np.sin(q)], -1)
            # A rod in the axes of its crank, which has turned by q about y.
            way = Rotation.from_rotvec(np.outer(-q, [0.0, 1.0, 0.0])).apply(place - end) / rod
            state[f"q{i + 1}"] = q
            for side in "ab":
                # Ry(u) Rx(v) (-z) = (-sin u cos v, sin v, -cos u cos v).
                state[f"u{i + 1}{side}"] = np.arctan2(-way[:, 0], -way[:, 2])
                state[f"v{i + 1}{side}"] = np.arcsin(way[:, 1])
        return state

    return Machine(
        name="delta",
        mechanism="delta",
        keys={"base": base, "crank": crank, "platform": platform, "rod": rod},
        units=("rad",) * 3,
        pose=("x", "y", "z"),
        low=None,
        high=None,
        lengths=lengths,
        model=model,
        start=start,
        stiff=np.full(3, 3e4),
        reach=crank + rod,
    )


def _leg(leg: int, now: Mapping[str, float], build: Build) -> str:
    """A crank with its two rods; the crank points outward, and its joint turns it downward."""
    crank, rod = now[f"crank{leg + 1}"], now[f"rod{leg + 1}"]
    turn = Rotation.from_rotvec([0.0, 0.0, now[f"angle{leg + 1}"]])
    carried, mass = inertia(1.5, (0.4 * crank, 0.0, 0.0), build)
    _, light = inertia(0.2, (0.0, 0.0, -0.5 * rod), build)
    rods = "".join(
        f"<body {placed((crank, aside, 0.0))} {carried}>{light}"
        f'<joint name="u{leg + 1}{side}" axis="0 1 0"/><joint name="v{leg + 1}{side}" axis="1 0 0"/>'
        f'<site name="end{leg + 1}{side}" pos="0 0 {-rod!r}"/></body>'
        for side, aside in (("a", _HALF), ("b", -_HALF))
    )
    foot = turn.apply([now[f"base{leg + 1}"], 0.0, 0.0])
    return f"<body {placed(foot, turn)} {carried}>{mass}{drive_joints(leg, (0.0, 1.0, 0.0), build)}{rods}</body>"
