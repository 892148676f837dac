"""A chain as its maker publishes it: a URDF, or a Denavit-Hartenberg table in YAML."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.delivered.chain import Chain, Place
from ccnn_validation.delivered.rotation import Array


def dh_chain(a: Sequence[float], alpha: Sequence[float], d: Sequence[float]) -> Chain:
    """A chain of turning joints from a standard Denavit-Hartenberg table [m, rad]: Rz(q) Tz(d) Tx(a) Rx(alpha)."""
    links: list[Place] = [(np.zeros(3), np.eye(3))]
    for length, twist, offset in zip(a, alpha, d, strict=True):
        links.append((np.array([length, 0, offset]), Rotation.from_euler("x", twist).as_matrix()))
    count = len(a)
    return Chain(tuple(links[:count]), np.tile([0.0, 0.0, 1.0], (count, 1)), ("rad",) * count, links[count])


def dh_text(name: str, a: Sequence[float], alpha: Sequence[float], d: Sequence[float]) -> str:
    """The table as a geometry file, lengths in mm."""
    mm = [[round(1e3 * v, 9) for v in values] for values in (a, d)]
    return (
        f"robot: {name}\ndof: {len(a)}\nconvention: standard Denavit-Hartenberg\n"
        f"units: {{length: mm, angle: rad}}\na: {mm[0]}\nalpha: {list(alpha)}\nd: {mm[1]}\n"
        f"theta: {[0.0] * len(a)}\nbase_frame: unknown\ntool_frame: unknown\n"
    )


def urdf_text(name: str, chain: Chain, low: Array, high: Array) -> str:
    """The chain as a URDF; `low` and `high` are limits of the joints [rad or m]."""
    lines = ['<?xml version="1.0"?>', f'<robot name="{name}">', '  <link name="base_link"/>']
    parent = "base_link"
    for i, (origin, axis) in enumerate(zip(chain.origins, chain.axes, strict=True)):
        kind = "revolute" if chain.units[i] == "rad" else "prismatic"
        lines += [
            f'  <link name="link_{i + 1}"/>',
            f'  <joint name="joint_{i + 1}" type="{kind}">',
            f"    {_origin(origin)}",
            f'    <parent link="{parent}"/>',
            f'    <child link="link_{i + 1}"/>',
            f'    <axis xyz="{_numbers(axis)}"/>',
            f'    <limit lower="{low[i]:.6f}" upper="{high[i]:.6f}" effort="0" velocity="6"/>',
            "  </joint>",
        ]
        parent = f"link_{i + 1}"
    lines += [
        '  <link name="flange"/>',
        '  <joint name="to_flange" type="fixed">',
        f"    {_origin(chain.flange)}",
        f'    <parent link="{parent}"/>',
        '    <child link="flange"/>',
        "  </joint>",
        "</robot>",
    ]
    return "\n".join(lines) + "\n"


def _origin(origin: Place) -> str:
    angles = Rotation.from_matrix(origin[1]).as_euler("xyz")
    return f'<origin xyz="{_numbers(origin[0])}" rpy="{_numbers(angles)}"/>'


def _numbers(values: Array) -> str:
    return " ".join(f"{v + 0.0:.12g}" for v in values)
