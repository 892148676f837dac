"""Open chains: a transform to each joint, a motion about or along its axis, and a flange; errors at every link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccnn_validation.delivered.rotation import Array, about, matrix

Place = tuple[Array, Array]
"""Position `3` [m] and rotation matrix `3 x 3`."""


def place(position: Sequence[float], vector: Sequence[float] = (0, 0, 0)) -> Place:
    """A place from its position [m] and rotation vector [rad]."""
    return np.array(position, float), matrix(np.array(vector, float))


@dataclass(frozen=True)
class Chain:
    """A chain as its maker says.

    Attributes:
        origins: transform from the frame of one joint (the base for the first) to the next.
        axes: axis of each joint in its own frame, `n x 3`.
        units: `rad` for a turning joint, `m` for a sliding one.
        flange: transform from the last joint's frame to the flange.
    """

    origins: tuple[Place, ...]
    axes: Array
    units: tuple[str, ...]
    flange: Place


def chain_pose(
    chain: Chain, joints: Array, base: Array, tool: Array, links: Array | None = None, growth: Array | None = None
) -> tuple[Array, Array]:
    """Position `s x 3` [m] and orientation `s x 3 x 3` of the tool.

    Args:
        chain: the maker's chain.
        joints: where the joints really are, `s x n` [rad or m].
        base, tool: place and rotation vector of the base in the measuring frame, of the tool at the flange, `6`.
        links: error of each joint's place: shift [m] and turn (rotation vector [rad]) in the frame before it, `n x 6`.
        growth: relative growth of the lengths before each joint, `s x n`.
    """
    rows, count = joints.shape
    rotation = np.broadcast_to(matrix(base[3:]), (rows, 3, 3))
    position = np.broadcast_to(base[:3], (rows, 3))
    for i in range(count):
        shift, turn = chain.origins[i]
        if links is not None:
            shift, turn = shift + links[i, :3], matrix(links[i, 3:]) @ turn
        length = 1.0 if growth is None else 1 + growth[:, i, None]
        position = position + (rotation @ shift) * length
        rotation = rotation @ turn
        if chain.units[i] == "rad":
            rotation = rotation @ about(chain.axes[i], joints[:, i])
        else:
            position = position + (rotation @ chain.axes[i]) * joints[:, i, None]
    shift, turn = chain.flange
    position = position + rotation @ shift
    rotation = rotation @ turn
    return position + rotation @ tool[:3], rotation @ matrix(tool[3:])


def joint_places(chain: Chain, joints: Array) -> tuple[Array, Array, Array]:
    """Of the maker's chain in its base: origins and axes of the joints, `s x n x 3`, and the flange, `s x 3`."""
    rows, count = joints.shape
    rotation, position = np.broadcast_to(np.eye(3), (rows, 3, 3)), np.zeros((rows, 3))
    origins, axes = [], []
    for i in range(count):
        shift, turn = chain.origins[i]
        position = position + rotation @ shift
        rotation = rotation @ turn
        origins.append(position)
        axes.append(rotation @ chain.axes[i])
        if chain.units[i] == "rad":
            rotation = rotation @ about(chain.axes[i], joints[:, i])
        else:
            position = position + axes[-1] * joints[:, i, None]
    return np.stack(origins, 1), np.stack(axes, 1), position + rotation @ chain.flange[0]
