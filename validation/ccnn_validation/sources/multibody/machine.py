"""A machine of this source: its MuJoCo model, and how its joints stand at a pose of the nominal mechanism."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_validation.sources.multibody.arrays import Array
from ccnn_validation.sources.multibody.build import Build

__all__ = ["Machine"]


@dataclass(frozen=True)
class Machine:
    """A machine.

    Attributes:
        name: within this source.
        mechanism: name or geometry text, as in `SourceCase`.
        keys: of the mechanism's constructor.
        units: of the joints, `n`.
        pose: measured coordinates, of x, y, z, rx, ry, rz.
        low, high: of the joints that are drawn, `n` [rad, m]; None = poses are drawn in the mechanism's workspace.
        lengths: nominal geometry that may be changed, name -> value [SI].
        model: from the machine as built to MJCF.
        start: from joints `s x n` and nominal pose `s x p` to the joints of the model, name -> `s`.
        stiff: a servo's usual stiffness by joint, `n` [N*m/rad, N/m].
        reach: a length of the machine [m].
    """

    name: str
    mechanism: str
    keys: Mapping[str, float] | None
    units: tuple[str, ...]
    pose: tuple[str, ...]
    low: Array | None
    high: Array | None
    lengths: Mapping[str, float]
    model: Callable[[Build], str]
    start: Callable[[Array, Array], Mapping[str, Array]]
    stiff: Array
    reach: float

    @property
    def drives(self) -> int:
        """Number of joints."""
        return len(self.units)

    @property
    def turns(self) -> bool:
        """The pose has an orientation."""
        return "rx" in self.pose

    def nominal(self) -> Mechanism:
        """The project's mechanism."""
        if "\n" not in self.mechanism:
            keys: dict[str, Any] = dict(self.keys or {})
            return load_mechanism(self.mechanism, **keys)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "machine.yaml"
            path.write_text(self.mechanism, encoding="utf-8")
            return load_mechanism(str(path), orientation="rotation_vector" if self.turns else "none")

    def compiled(self, build: Build) -> mujoco.MjModel:
        """The MuJoCo model of the machine as built."""
        return mujoco.MjModel.from_xml_string(self.model(build))

    def begin(self, model: mujoco.MjModel, joints: Array, pose: Array) -> Array:
        """All joints of a model at nominal poses, `s x v`."""
        state = np.zeros((len(joints), model.nq))
        for name, values in self.start(joints, pose).items():
            state[:, model.joint(name).id] = values
        return state

    def forward(self, mechanism: Mechanism, joints: Array) -> Array:
        """Nominal poses, `s x p`; NaN out of reach."""
        with torch.no_grad():
            return np.asarray(mechanism.forward_kinematics(torch.from_numpy(joints)).numpy())

    def inverse(self, mechanism: Mechanism, pose: Array) -> Array:
        """Nominal joints of poses, `s x n`; NaN out of reach."""
        with torch.no_grad():
            return np.asarray(mechanism.solve_inverse(torch.from_numpy(pose)).numpy())
