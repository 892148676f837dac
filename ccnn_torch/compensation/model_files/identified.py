"""An identified machine as a model: commands by its real kinematics, without any network."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.guard import Promise, as_rows, kept
from ccnn_torch.compensation.model_files.card import MODEL_FORMS, card_of, read_model
from ccnn_torch.compensation.model_files.load import LoadedModel, load_model, machine_of_model
from ccnn_torch.compensation.model_files.metadata import description_of, from_json
from ccnn_torch.compensation.model_files.signature import check_signature, sign_content, signature_path
from ccnn_torch.compensation.parts import ROWS, all_over, machine_alone
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.effects.found_machine import FoundMachine, machine_of_block
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
        path: the file.
        machine: as it was found.
        nominal, identified: the mechanism with either geometry.
        compensator: the machine as a compensator that has learned nothing.
        joints, covariates, pose: coordinates in order; geometry alone has no covariates.
        facts: `mechanism`: the nominal one's description.
        columns: the map of columns that its records had: header in a file -> ``name[unit]`` or ``ignore``.
        joint_map: joint -> sum of columns, where its controller counts otherwise.
        signed: whether a signature was asked for: then what no signature covers is not believed.
    """

    def __init__(
        self,
        path: Path,
        machine: FoundMachine,
        rows: Callable[[], Situation] | None = None,
        signed: bool = False,
    ) -> None:
        """Take a machine.

        Args:
            path: the file.
            machine: as it was found.
            rows: of geometry alone, that fill its domain; all over the measured region when None.
            signed: see the class.
        """
        self.path, self.machine, self.signed = path, machine, signed
        self._rows = rows
        self.nominal, self.identified = machine.nominal, machine.identified
        self.joints: tuple[Coordinate, ...] = self.nominal.joints
        self.pose: tuple[Coordinate, ...] = self.nominal.pose
        self.columns, self.joint_map, self.covariates = machine.columns, machine.joint_map, machine.covariates
        self.facts: dict[str, Any] = {"mechanism": self.nominal.describe()}

    @cached_property
    def compensator(self) -> Compensator:
        """Made when a command is first asked for; raises ModelFileError where the machine cannot be commanded."""
        try:
            if self._rows is not None:
                return machine_alone(self._rows(), self.machine.values, margin=0.0)
            about = (self.machine.values, self.machine.acting, self.covariates)
            return machine_alone(self.machine.rows(ROWS), *about)
        except (InputError, MethodFailedError) as reason:
            raise ModelFileError(f"{self.path}: {reason}") from None

    @cached_property
    def _promise(self) -> Promise:
        return Promise.of_card(description_of(self.compensator))

    @property
    def region(self) -> Array:
        """Lowest and highest joints measured, or of the workspace where that is not known, `n x 2` [SI]."""
        if self._rows is None:
            measured: Array = self.machine.joints.numpy()
            return measured
        joints = self._rows().joints
        fine = joints[torch.isfinite(joints).all(-1)]
        return np.stack([fine.amin(0).numpy(), fine.amax(0).numpy()], -1)

    @property
    def middle(self) -> Array:
        """Joints to begin a search from, `n` [SI]."""
        home: Array = self.nominal.home_joints.numpy()
        return home

    def __call__(self, joints: ArrayLike, covariates: ArrayLike | None = None) -> dict[str, Array]:
        """Commands of ideal joints, and ideal joints were they commands.

        Args:
            joints: `... x n` [SI].
            covariates: `... x m` [SI] in the order of `covariates`; None where there are none.

        Returns:
            As a `LoadedModel`, without `deviation_sd`: there is no learner.

        Raises:
            InputError: covariates are missing, or a last dimension is wrong.
        """
        rows, flat, lead = as_rows(joints, covariates, (self.joints, self.covariates))
        compensator, given = self.compensator, None if flat is None else torch.tensor(flat)
        with torch.no_grad():
            found = {k: v.numpy() for k, v in compensator.solve(torch.tensor(rows), given)._asdict().items()}
        checked = kept(found, rows, flat, self._promise)
        del checked["deviation_sd"]
        return {name: value.reshape((*lead, *value.shape[1:])) for name, value in checked.items()}


def load_geometry(
    path: str | Path, *, public_key: str | Path | None = None, allow_code: bool = False
) -> IdentifiedGeometry:
    """Read `identified.yaml`, the `identified.yaml` beside an `identified.json`, or a `diagnosis.json`.

    Raises:
        ModelFileError: the file is not one that `ccnn identify` or `ccnn diagnose` wrote.
        InputError: it lacks a key or a parameter, or names code that was not allowed.
    """
    path = Path(path)
    source, content = _read_geometry(path)
    if public_key is not None:
        check_signature(source, content, b"", public_key)
    if source.suffix == ".json" and (diagnosed := _diagnosed(path, content, allow_code)) is not None:
        return IdentifiedGeometry(path, diagnosed, signed=public_key is not None)
    file = _parsed(path, source, content)
    nominal, identified = (mechanism_of_file(file, what, allow_code) for what in ("nominal", "value"))
    none = torch.zeros(0, 2, dtype=torch.float64)
    about = (default_gravity(nominal), none, (), none, file.columns, file.joint_map)
    machine = FoundMachine(nominal, identified.nominal, [], *about)
    return IdentifiedGeometry(path, machine, lambda: all_over(nominal), public_key is not None)


def load_machine(path: str | Path, *, allow_code: bool = False) -> Mechanism:
    """The machine of any file that a command writes, identified parameters as the nominal ones, without effects.

    Args, raises: as of `load_compensation`.
    """
    found = load_compensation(path, allow_code=allow_code)
    return found.identified if isinstance(found, IdentifiedGeometry) else machine_of_model(found, allow_code)


def _diagnosed(path: Path, content: bytes, allow_code: bool) -> FoundMachine | None:
    """The machine in a diagnosis.json; None where the file is another one."""
    try:
        found = from_json(content)
        block = found["machine"]
    except (ValueError, KeyError, TypeError):
        return None
    if block is None:
        raise ModelFileError(f"{path}: machine: no effect was named that a model could hold; calibrate with ccnn run")
    return machine_of_block(block, str(path), allow_code)


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
        if source.suffix != ".json":
            _parsed(path, source, content)
        path, card = source, b""
    else:
        content = read_model(path)
        card = card_of(path, content)[1]
    signature = sign_content(content, card, key)
    write_whole(signature_path(path), signature)
    return signature_path(path)


def _read_geometry(path: Path) -> tuple[Path, bytes]:
    """The file of an identified machine, for its identified.json the one beside it; and its bytes."""
    beside = path.with_suffix(".yaml")
    source = beside if path.suffix == ".json" and beside.is_file() else path
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
