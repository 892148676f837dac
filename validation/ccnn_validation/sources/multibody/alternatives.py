"""Which simple names explain the same rows as well: where a cause cannot be told from them, they are right too."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_torch.mechanisms import Mechanism
from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.design import Design
from ccnn_validation.sources.multibody.machine import Machine
from ccnn_validation.sources.multibody.plan import gap

__all__ = ["as_right", "columns_of", "left_after"]

# What a name cannot copy, over all rows together and in units of the noise: below this either name is right.
_HIDDEN = 5.0


def as_right(machine: Machine, mechanism: Mechanism, design: Design, error: Array, noise: Array) -> tuple[str, ...]:
    """Names that copy an error `s x p` to within the noise `p`."""
    columns = columns_of(machine, mechanism, design)
    return tuple(name for name, basis in columns.items() if left_after(error, basis, noise) < _HIDDEN)


def left_after(error: Array, basis: Array, noise: Array) -> float:
    """Norm over all rows of what columns `s x p x k` leave of an error `s x p`, in units of the noise."""
    wanted = (error / noise).ravel()
    flat = (basis / noise[:, None]).reshape(len(wanted), -1)
    flat = flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    return float(np.linalg.norm(wanted - flat @ np.linalg.lstsq(flat, wanted, rcond=1e-10)[0]))


def columns_of(machine: Machine, mechanism: Mechanism, design: Design) -> dict[str, Array]:
    """Changes of the pose by each name's coefficients, `s x p x k`."""
    step = 1e-6
    # All joints ahead and behind in one call, `2n s x n`.
    moves = step * np.concatenate([np.eye(machine.drives), -np.eye(machine.drives)])
    moved = machine.forward(mechanism, (design.joints + moves[:, None, :]).reshape(-1, machine.drives))
    ahead, behind = np.split(moved, 2)
    by_joint = (gap(machine, ahead, behind) / (2 * step)).reshape(machine.drives, *design.pose.shape).transpose(1, 2, 0)
    space = np.zeros((len(design.pose), 3))
    places = [c for c in machine.pose if c in ("x", "y", "z")]
    space[:, : len(places)] = design.pose[:, : len(places)]
    turned = np.stack([np.cross(axis, space) for axis in np.eye(3)], -1)
    shifted = np.broadcast_to(np.eye(3), turned.shape)
    # A scale of each axis, and what each pair of axes leans: the part of it that is no turn.
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    strain = np.stack([space[:, [j]] * np.eye(3)[i] + space[:, [i]] * np.eye(3)[j] for i, j in pairs], -1)
    columns = {
        "joint_offset": by_joint,
        "joint_gain": by_joint * design.joints[:, None, :],
        "frame": _seen(machine, np.concatenate([shifted, turned], -1), np.eye(3)),
        "instrument": _seen(machine, np.concatenate([shifted, strain], -1), np.zeros((3, 3))),
    }
    if machine.turns:
        turn = Rotation.from_rotvec(design.pose[:, 3:]).as_matrix()
        place = np.concatenate([turn, np.zeros_like(turn)], 1)
        columns["tool"] = np.concatenate([place, np.concatenate([np.zeros_like(turn), turn], 1)], -1)
    return columns


def _seen(machine: Machine, moved: Array, turned: Array) -> Array:
    """Changes of the position `s x 3 x k`, and of the rotation by the last of them, as the machine's pose has them."""
    places = sum(c in ("x", "y", "z") for c in machine.pose)
    if not machine.turns:
        return moved[:, :places]
    angles = np.zeros_like(moved)
    angles[:, :, 3:6] = turned
    return np.concatenate([moved, angles], 1)
