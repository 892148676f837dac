"""An identified machine as a model: commands by its real kinematics, without any network."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike, NDArray

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.guard import Promise, as_matrix, kept
from ccnn_torch.compensation.machine.alone import machine_alone
from ccnn_torch.compensation.model_files.card import MODEL_FORMS, card_of, read_model
from ccnn_torch.compensation.model_files.load import LoadedModel, load_model
from ccnn_torch.compensation.model_files.signature import check_signature, sign_content, signature_path
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError, ModelFileError
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms import Mechanism, mechanism_of_file
from ccnn_torch.mechanisms.files.mechanism_file import MechanismFile, read_mechanism_file

Array = NDArray[Any]

_FORMS = (".yaml", ".yml", ".json")


class IdentifiedGeometry:
    """What `LoadedModel` is for a network, for identified geometry; the same call, the same names.

    An ideal joint vector means the pose f(q; nominal); the command is that of the identified machine at this pose.

    Attributes:
        path: the mechanism file.
        nominal, identified: the mechanism with either geometry.
        compensator: both as a compensator that has learned nothing.
        joints, covariates, pose: coordinates in order; geometry has no covariates.
        facts: `mechanism`: the nominal one's description.
        columns: the map of columns that its records had: header in a file -> ``name[unit]`` or ``ignore``.
        joint_map: joint -> sum of columns, where its controller counts otherwise.
    """

    def __init__(
        self,
        path: Path,
        nominal: Mechanism,
        identified: Mechanism,
        columns: dict[str, str] | None = None,
        joint_map: dict[str, str] | None = None,
    ) -> None:
        """Take both geometries of one mechanism.

        Raises:
            ModelFileError: the machine has no closed form, and its geometry is no polynomial of the joints either.
        """
        self.path, self.nominal, self.identified = path, nominal, identified
        self.joints: tuple[Coordinate, ...] = nominal.joints
        self.pose: tuple[Coordinate, ...] = nominal.pose
        self.columns = columns or {}
        self.joint_map = joint_map or {}
        self.covariates: tuple[Coordinate, ...] = ()
        self.facts: dict[str, Any] = {"mechanism": nominal.describe()}

    @cached_property
    def compensator(self) -> Compensator:
        """Made when a command is first asked for."""
        try:
            return machine_alone(self.nominal, self.identified)
        except MethodFailedError as reason:
            raise ModelFileError(f"{self.path}: {reason}") from None

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
            As a `LoadedModel`, without `deviation_sd`: there is no learner.

        Raises:
            InputError: the last dimension is wrong.
        """
        array = as_matrix(joints, self.joints, "joints")
        rows = array.reshape(-1, array.shape[-1])
        compensator = self.compensator
        with torch.no_grad():
            found = {k: v.numpy() for k, v in compensator.solve(torch.tensor(rows))._asdict().items()}
        checked = kept(found, rows, None, Promise.of_compensator(compensator))
        del checked["deviation_sd"]
        return {name: value.reshape((*array.shape[:-1], *value.shape[1:])) for name, value in checked.items()}


def load_geometry(
    path: str | Path, *, public_key: str | Path | None = None, allow_code: bool = False
) -> IdentifiedGeometry:
    """Read `identified.yaml`, or the `identified.yaml` beside an `identified.json`.

    Raises:
        ModelFileError: the file is not one that `ccnn identify` wrote.
        InputError: it lacks a key or a parameter, or names code that was not allowed.
    """
    path = Path(path)
    source, content = _read_geometry(path)
    if public_key is not None:
        check_signature(source, content, b"", public_key)
    file = _parsed(path, source, content)
    nominal, identified = (mechanism_of_file(file, what, allow_code) for what in ("nominal", "value"))
    return IdentifiedGeometry(path, nominal, identified, file.columns, file.joint_map)


def load_compensation(
    path: str | Path, *, public_key: str | Path | None = None, allow_code: bool = False
) -> LoadedModel | IdentifiedGeometry:
    """A model file (.safetensors, .onnx) or an identified machine (.yaml, .json), by what the name ends in.

    Args:
        path: the file.
        public_key, allow_code: as `load_model`.

    Raises:
        ModelFileError, InputError: see `load_model` and `load_geometry`.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*_FORMS, *MODEL_FORMS, ".pt2") and Path(path).is_file():
        raise ModelFileError(
            f"{path}: is no model file; one ends in {', '.join(MODEL_FORMS)}, or is an identified.yaml"
        )
    load = load_geometry if suffix in _FORMS else load_model
    return load(path, public_key=public_key, allow_code=allow_code)


def sign_model(path: str | Path, key: str | Path) -> Path:
    """Write MODEL.sig beside a model: the signature of the file and of the card that vouches for it.

    Args:
        path: as for `load_compensation`; an identified.yaml has no card.
        key: PEM file with a private Ed25519 key.

    Raises:
        ModelFileError: the file cannot be read, or no card vouches for it.
        InputError: the key is none, or the package for signatures is missing.
    """
    path = Path(path)
    if path.suffix.lower() in _FORMS:
        source, content = _read_geometry(path)
        _parsed(path, source, content)
        path, card = source, b""
    else:
        content = read_model(path)
        card = card_of(path, content)[1]
    signature = sign_content(content, card, key)
    write_whole(signature_path(path), signature)
    return signature_path(path)


def _read_geometry(path: Path) -> tuple[Path, bytes]:
    """The mechanism file of an identified machine, and its bytes."""
    source = path.with_suffix(".yaml") if path.suffix == ".json" else path
    try:
        return source, source.read_bytes() if source.is_file() else b""
    except OSError as reason:
        raise ModelFileError(f"{source}: cannot be read: {reason.strerror}") from None


def _parsed(path: Path, source: Path, content: bytes) -> MechanismFile:
    try:
        file = read_mechanism_file(str(source), content)
    except InputError as reason:
        raise ModelFileError(f"{reason}; {path} is no model file: give identified.yaml or model.safetensors") from None
    if file is None:
        raise ModelFileError(
            f"{path}: there is no identified machine; give the identified.yaml that ccnn identify writes, which holds "
            "the nominal parameters, too"
        )
    return file
