"""What an entry of the benchmark gets and gives: rows in, a function that predicts poses out. NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Predict = Callable[[Floats, Floats], Floats]
"""Joints `n x k` and covariates `n x m` (m may be 0) to poses `n x p` [SI]."""
# Metres that a radian counts: the reach of a wrist.
ROTATION = 0.3


@dataclass(frozen=True)
class Arm:
    """The maker's Denavit-Hartenberg table [m, rad], `k` each; modified: link i = Rx Tx Rz Tz, else Rz Tz Tx Rx."""

    modified: bool
    a: Floats
    alpha: Floats
    d: Floats
    theta: Floats


@dataclass(frozen=True)
class Rows:
    """Measured rows [SI].

    Attributes:
        joints: `n x k`, turning joints.
        poses: positions `n x 3`, or with rotation vectors `n x 6`; base and tool frames are unknown.
        covariates: what was measured beside, `n x m`; names has the `m` names.
        frame: number of the measuring frame of each row, `n`. Where there are several, predictions may be in any one
            frame of the entry's (the base): they are judged after a rigid motion for each frame.
        arm: nominal geometry; nominal is its file.
        sockets: poses are places of sockets that a ball on the tool was put into.
    """

    joints: Floats
    poses: Floats
    covariates: Floats
    frame: Ints
    names: tuple[str, ...]
    arm: Arm
    nominal: Path
    sockets: bool = False

    def take(self, index: Ints) -> Rows:
        """The rows of an index."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)[:4]})

    @property
    def several(self) -> bool:
        """Whether there is more than one measuring frame."""
        return len(np.unique(self.frame)) > 1

    def with_values(self, **values: Any) -> Rows:
        return replace(self, **values)


@dataclass(frozen=True)
class Fit:
    """A fitted entry: poses of joints and covariates, and if it has any, half widths of 95 % intervals, alike."""

    predict: Predict
    half_width: Predict | None = None


@dataclass(frozen=True)
class Entry:
    """One method.

    Attributes:
        fit: from training rows.
        changed: what changed from one set of rows to another by `zero J` [rad], `a J`, `d J` [m], `gain J` [1] of joint
            or link J from 1; None where the method has no geometry.
        sockets: whether it is for sockets (True), for poses (False), or both (None).
        about: one line for the table.
    """

    fit: Callable[[Rows], Fit]
    about: str
    changed: Callable[[Rows, Rows], dict[str, float]] | None = None
    sockets: bool | None = None


def rigid(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Rotation `3 x 3` and shift `3` that take poses `n x p` nearest to others (Kabsch; a radian counts 0.3 m)."""
    p, t = source[:, :3], target[:, :3]
    about, to = p.mean(0), t.mean(0)
    product = (t - to).T @ (p - about)
    if source.shape[1] == 6:
        turned, wanted = matrices(source[:, 3:]), matrices(target[:, 3:])
        product = product + ROTATION**2 * np.einsum("nij,nkj->ik", wanted, turned)
    u, _, vt = np.linalg.svd(product)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return turn, to - turn @ about


def moved(poses: Floats, turn: Floats, shift: Floats) -> Floats:
    """Poses in another frame, `n x p`."""
    place = poses[:, :3] @ turn.T + shift
    return place if poses.shape[1] == 3 else np.hstack([place, vectors(turn @ matrices(poses[:, 3:]))])


def errors(measured: Floats, predicted: Floats) -> Floats:
    """Measured less predicted, `n x p` [m, rad]; the rotation is the vector of R_measured R_predictedᵀ."""
    gap = measured[:, :3] - predicted[:, :3]
    if measured.shape[1] == 3:
        return gap
    turn = matrices(measured[:, 3:]) @ matrices(predicted[:, 3:]).transpose(0, 2, 1)
    return np.hstack([gap, vectors(turn)])


def matrices(rotation_vectors: Floats) -> Floats:
    """Rotation matrices `n x 3 x 3`."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(rotation_vectors).as_matrix())


def vectors(rotations: Floats) -> Floats:
    """Rotation vectors `n x 3` [rad]."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_rotvec())
