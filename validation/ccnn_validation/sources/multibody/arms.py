"""Serial machines in MuJoCo from tables of Denavit and Hartenberg: two arms of six joints, one of seven, a gantry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build, document, drive_joints, inertia, numbers, placed
from ccnn_validation.sources.multibody.machine import Machine

__all__ = ["gantry", "puma", "seven", "slim"]

_H = float(np.pi / 2)


def puma() -> Machine:
    """An arm of the Puma 560's proportions."""
    return _serial(
        "puma",
        a=(0.0, 0.4318, 0.0203, 0.0, 0.0, 0.0),
        alpha=(_H, 0.0, -_H, _H, -_H, 0.0),
        d=(0.672, 0.0, 0.15, 0.4318, 0.0, 0.12),
        masses=(15.0, 17.0, 5.0, 1.2, 0.8, 0.5),
        middle=(0.0, 0.8, -0.8, 0.0, 0.9, 0.0),
        half=(1.6, 0.7, 0.8, 1.5, 0.7, 2.0),
        stiff=(8e4, 8e4, 5e4, 1e4, 1e4, 8e3),
    )


def slim() -> Machine:
    """A light arm with three parallel axes, of the UR5's proportions."""
    return _serial(
        "slim",
        a=(0.0, -0.425, -0.392, 0.0, 0.0, 0.0),
        alpha=(_H, 0.0, 0.0, _H, -_H, 0.0),
        d=(0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996),
        masses=(3.7, 8.4, 2.3, 1.2, 1.2, 0.3),
        middle=(0.0, -1.3, 1.5, -1.0, -1.3, 0.0),
        half=(2.0, 0.6, 0.8, 1.0, 0.7, 2.0),
        stiff=(5e4, 5e4, 3e4, 1e4, 8e3, 6e3),
    )


def seven() -> Machine:
    """An arm of seven joints with spherical shoulder and wrist, of the iiwa's proportions."""
    return _serial(
        "seven",
        a=(0.0,) * 7,
        alpha=(-_H, _H, _H, -_H, -_H, _H, 0.0),
        d=(0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126),
        masses=(5.0, 5.5, 4.0, 3.5, 2.5, 2.0, 0.6),
        middle=(0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0),
        half=(1.8, 0.7, 1.2, 0.7, 1.4, 0.6, 2.0),
        stiff=(6e4, 6e4, 4e4, 4e4, 2e4, 1e4, 1e4),
    )


def gantry() -> Machine:
    """Three slides at right angles: q1 up, q2 along y, q3 along x; its tool's position is measured alone."""
    return _serial(
        "gantry",
        a=(0.0, 0.0, 0.0),
        alpha=(-_H, _H, 0.0),
        d=(0.2, 0.1, 0.15),
        theta=(0.0, _H, 0.0),
        masses=(40.0, 25.0, 10.0),
        middle=(0.5, 0.5, 0.5),
        half=(0.45, 0.45, 0.45),
        stiff=(3e7, 2e7, 1e7),
        sliding=True,
    )


def _serial(
    name: str,
    a: Sequence[float],
    alpha: Sequence[float],
    d: Sequence[float],
    masses: Sequence[float],
    middle: Sequence[float],
    half: Sequence[float],
    stiff: Sequence[float],
    theta: Sequence[float] | None = None,
    sliding: bool = False,
) -> Machine:
    """A machine from its table, the box of its joints, masses of its links and stiffness of its servos."""
    n = len(a)
    table = {"a": a, "alpha": alpha, "d": d, "theta": theta or (0.0,) * n}
    lengths = {f"{key}{i + 1}": float(v) for key, row in table.items() for i, v in enumerate(row)}

    def model(build: Build) -> str:
        now = {**lengths, **build.lengths}
        tool = placed(build.tool[:3], Rotation.from_rotvec(build.tool[3:]))
        extra = f"<body>{inertia(build.payload, (0, 0, 0), build)[1]}</body>" if build.payload else ""
        end = f'<site name="tool" {tool}/>{extra}'
        return document(_link(0, n, now, masses, build, end, sliding), [], n, build, (0.0, 0.0, -1.0))

    def start(joints: Array, pose: Array) -> Mapping[str, Array]:
        return {f"q{i + 1}": joints[:, i] for i in range(n)}

    return Machine(
        name=name,
        mechanism=_file(name, table, n, sliding),
        keys=None,
        units=("m" if sliding else "rad",) * n,
        pose=("x", "y", "z") if sliding else ("x", "y", "z", "rx", "ry", "rz"),
        low=np.array(middle) - np.array(half),
        high=np.array(middle) + np.array(half),
        lengths=lengths,
        model=model,
        start=start,
        stiff=np.array(stiff),
        reach=1.0,
    )


def _link(
    i: int, n: int, now: Mapping[str, float], masses: Sequence[float], build: Build, end: str, sliding: bool
) -> str:
    """Link i and all behind it: a body that the joint moves, and within it the frame of the next link.

    Rz(q + theta) and the slide along z are the joint; then d along z, a along x, and the turn by alpha about x.
    """
    if i == n:
        return end
    a, alpha, d, theta = (now[f"{key}{i + 1}"] for key in ("a", "alpha", "d", "theta"))
    # A motor's weight sits near its joint: the centre of mass is not at the middle of the link.
    carried, mass = inertia(masses[i], (0.4 * a, 0.02, 0.4 * d), build)
    rest = _link(i + 1, n, now, masses, build, end, sliding)
    turned = Rotation.from_rotvec([0.0, 0.0, theta])
    tilted = Rotation.from_rotvec([alpha, 0.0, 0.0])
    return (
        f"<body {placed((0.0, 0.0, 0.0), turned)} {carried}>{mass}{drive_joints(i, (0.0, 0.0, 1.0), build, sliding)}"
        f"<body {placed((a, 0.0, d), tilted)}>{rest}</body></body>"
    )


def _file(name: str, table: Mapping[str, Sequence[float]], n: int, sliding: bool) -> str:
    """The geometry file with both frames known."""
    rows = "".join(f"{key}: [{numbers(row).replace(' ', ', ')}]\n" for key, row in table.items())
    kind = f"joint_types: [{', '.join(['prismatic'] * n)}]\n" if sliding else ""
    frame = f"tool_frame: identity\n{'tool_offset: [0, 0, 0]' + chr(10) if sliding else ''}"
    return (
        f"robot: {name}\ndof: {n}\nconvention: standard Denavit-Hartenberg\nunits: {{length: m, angle: rad}}\n"
        f"{kind}{rows}base_frame: identity\n{frame}"
    )
