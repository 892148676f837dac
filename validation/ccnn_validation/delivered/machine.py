"""What every machine has: unknown numbers in blocks, a pose that follows from them, a box of joints, and its noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ccnn_validation.delivered.rotation import Array

Covariates = Mapping[str, Array]
"""Columns of `s` rows in SI (temperature in °C): `temperature`, `load_z`, `direction1` …"""


@dataclass(frozen=True)
class Pose:
    """Poses of `s` rows.

    Attributes:
        position: `s x 3`, planar machines `s x 2` [m].
        rotation: `s x 3 x 3`; None where the machine has no orientation.
    """

    position: Array
    rotation: Array | None


@dataclass(frozen=True)
class Block:
    """Unknown numbers of one kind.

    Attributes:
        name: of the block.
        nominal: what the maker says.
        true: of this machine.
        prior: standard deviation about `centre` that the reference takes for granted.
        centre: where the reference starts; the nominal value, and for frames the true one under a weak prior.
    """

    name: str
    nominal: Array
    true: Array
    prior: Array
    centre: Array


Model = Callable[[Mapping[str, Array], Array, Covariates], "Pose"]
"""Pose of joints `s x n` and covariates under the unknowns by block."""


@dataclass(frozen=True)
class Files:
    """How the machine is told to the program: a mechanism's name or file, its keys, and what the file holds."""

    mechanism: str
    keys: Mapping[str, float]
    text: str | None


@dataclass(frozen=True)
class Machine:
    """A machine as it was built.

    Attributes:
        kind, seed: which machine it is.
        extras: errors beside geometry, zeros and gears: `sag`, `payload`, `backlash`, `thermal`.
        units: `rad` or `m` of each joint.
        low, high: box of the measured joints [rad or m].
        wrist: joint that passes its singular value 0 on the line through the wrist; None where there is none.
        blocks: the unknowns, in the order of the vector.
        model: pose of joints `s x n` and covariates under the unknowns by block.
        noise: standard deviation of a measured coordinate of the position [m] and of the orientation [rad].
        files: how the program is told of it.
    """

    kind: str
    seed: int
    extras: tuple[str, ...]
    units: tuple[str, ...]
    low: Array
    high: Array
    wrist: int | None
    blocks: tuple[Block, ...]
    model: Model
    noise: tuple[float, float]
    files: Files

    def vector(self, what: str) -> Array:
        """`nominal`, `true`, `prior` or `centre` values of all unknowns, one after the other."""
        return np.concatenate([np.ravel(getattr(block, what)) for block in self.blocks])

    @property
    def frames(self) -> int:
        """How many unknowns at the head of the vector are base and tool frame (12 or 0)."""
        return 12 if self.blocks[0].name == "base_frame" else 0

    def pose(self, unknowns: Array, joints: Array, covariates: Covariates) -> Pose:
        """Pose of the machine with the unknowns of a vector."""
        values, at = {}, 0
        for block in self.blocks:
            values[block.name] = unknowns[at : at + block.nominal.size].reshape(block.nominal.shape)
            at += block.nominal.size
        return self.model(values, joints, covariates)

    def true_pose(self, joints: Array, covariates: Covariates) -> Pose:
        """Where the machine really goes."""
        return self.pose(self.vector("true"), joints, covariates)

    def nominal_pose(self, frames: Array, joints: Array) -> Pose:
        """Where its maker says that it goes, in given frames (base, then tool: place and rotation vector)."""
        unknowns = np.concatenate([frames, self.vector("nominal")[self.frames :]])
        return self.pose(unknowns, joints, resting(joints))


def resting(joints: Array) -> dict[str, Array]:
    """Covariates at which nominal machines are said: 20 °C, no load, no direction."""
    rows, count = joints.shape
    return {
        "temperature": np.full(rows, 20.0),
        "load_z": np.zeros(rows),
        **{f"direction{i + 1}": np.zeros(rows) for i in range(count)},
    }


def finite(pose: Pose) -> NDArray[np.bool_]:
    """Which rows have a pose."""
    return np.asarray(np.isfinite(pose.position).all(-1))
