"""An identified machine as a model: commands by its real kinematics, without any network."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ccnn_torch.compensation._loaded import LoadedModel, load_model
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.mechanisms.mechanism_file import read_mechanism_file

__all__ = ["IdentifiedGeometry", "load_compensation", "load_geometry"]

Array = NDArray[Any]

# How near to a pose the joints must bring a machine [m, rad].
_CLOSE = 1e-8
# How far joints may be from those that the inverse kinematics give for their pose [SI].
_SAME = 1e-6
_FORMS = (".yaml", ".yml", ".json")
MODEL_FORMS = (".safetensors", ".onnx", ".pt2")


class IdentifiedGeometry:
    """What `LoadedModel` is for a network, for identified geometry; the same call, the same names.

    An ideal joint vector means the pose f(q; nominal); the command is g(that pose; identified), on the same branch.

    Attributes:
        path: the mechanism file.
        nominal, identified: the mechanism with either geometry.
        joints, covariates, pose: coordinates in order; geometry has no covariates.
        facts: `mechanism`: the nominal one's description.
    """

    def __init__(self, path: Path, nominal: Mechanism, identified: Mechanism) -> None:
        """Take both geometries of one mechanism."""
        self.path, self.nominal, self.identified = path, nominal, identified
        self.joints: tuple[Coordinate, ...] = nominal.joints
        self.pose: tuple[Coordinate, ...] = nominal.pose
        self.covariates: tuple[Coordinate, ...] = ()
        self.facts: dict[str, Any] = {"mechanism": nominal.describe()}

    @property
    def middle(self) -> Array:
        """Joints to begin a search from, `n` [SI]."""
        home: Array = self.nominal.home_joints.numpy()
        return home

    def __call__(self, joints: ArrayLike, covariates: ArrayLike | None = None) -> dict[str, Array]:
        """Commands of ideal joints, and ideal joints were they commands.

        Args:
            joints: `... x n` [SI].
            covariates: none.

        Returns:
            `command`, `deviation` and `ideal`, `... x n` [SI]; `inside_domain` and `ideal_inside_domain`, `...`, bool:
            False where the machine cannot take the pose, and the joints come back as they are.
        """
        given = torch.as_tensor(np.asarray(joints, dtype=np.float64))
        if given.ndim == 0 or given.shape[-1] != len(self.joints):
            names = ", ".join(c.header for c in self.joints)
            raise InputError(
                f"the model takes the joints {names} as last dimension; got the shape {tuple(given.shape)}"
            )
        command, inside = _carried(self.nominal, self.identified, given)
        ideal, ideal_inside = _carried(self.identified, self.nominal, given)
        return {
            "command": command.numpy(),
            "deviation": (given - command).numpy(),
            "inside_domain": inside.numpy(),
            "ideal": ideal.numpy(),
            "ideal_inside_domain": ideal_inside.numpy(),
        }


def load_geometry(path: str | Path) -> IdentifiedGeometry:
    """Read `identified.yaml`, or the `identified.json` beside it.

    Raises:
        ModelFileError: the file is not one that `ccnn identify` wrote.
        InputError: it lacks a key or a parameter.
    """
    path = Path(path)
    source = path.with_suffix(".yaml") if path.suffix == ".json" else path
    try:
        file = read_mechanism_file(str(source))
    except InputError as reason:
        raise ModelFileError(f"{reason}; {path} is no model file: give identified.yaml or model.safetensors") from None
    if file is None:
        raise ModelFileError(
            f"{path}: there is no identified machine; give the identified.yaml that ccnn identify writes, which holds "
            "the nominal parameters, too"
        )
    identified = load_mechanism(str(source))
    nominal = load_mechanism(file.spec, **file.keys)
    nominal.set_parameters(file.parameters_of(nominal, "nominal"))
    return IdentifiedGeometry(path, nominal, identified)


def load_compensation(path: str | Path) -> LoadedModel | IdentifiedGeometry:
    """A model file (.safetensors, .onnx, .pt2) or an identified machine (.yaml, .json), by what the name ends in.

    Raises:
        ModelFileError: it is no model file; see `load_model` and `load_geometry`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*_FORMS, *MODEL_FORMS) and Path(path).is_file():
        raise ModelFileError(
            f"{path}: is no model file; one ends in {', '.join(MODEL_FORMS)}, or is an identified.yaml"
        )
    return load_geometry(path) if suffix in _FORMS else load_model(path)


@torch.no_grad()
def _carried(first: Mechanism, second: Mechanism, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Joints of `second` at the poses that `first` takes with `joints`, and where there are any."""
    pose = first.forward_kinematics(joints)
    found = second.solve_inverse(pose, guess=joints)
    error = second.pose_error(second.forward_kinematics(found, guess=pose), pose)
    # A comparison with NaN is false, so a pose without joints is not reached either.
    reached = error.position < _CLOSE
    if error.rotation is not None:
        reached = reached & (error.rotation < _CLOSE)
    # Joints in another working mode take a pose that our inverse kinematics would take with far-off joints.
    reached &= first.wrap(first.solve_inverse(pose, guess=joints) - joints).abs().amax(-1) < _SAME
    return torch.where(reached[..., None], found, joints), reached
