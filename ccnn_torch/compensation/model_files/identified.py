"""An identified machine as a model: commands by its real kinematics, without any network."""

from __future__ import annotations

from pathlib import Path

import torch

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.fit import machine_alone, rows_of
from ccnn_torch.compensation.model_files.load import MACHINE_FORMS, LoadedModel, load_compensation, read_model
from ccnn_torch.compensation.model_files.metadata import card_of, from_json
from ccnn_torch.compensation.model_files.signature import check_signature, sign_content, signature_path
from ccnn_torch.effects import default_gravity
from ccnn_torch.effects.columns import inside
from ccnn_torch.effects.found_machine import FoundMachine, machine_of_block
from ccnn_torch.errors import InputError, MethodFailedError, ModelFileError
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms import Mechanism, mechanism_of_file
from ccnn_torch.mechanisms.mechanism_file import MechanismFile, read_mechanism_file


def model_of_machine(path: Path, machine: FoundMachine, signed: bool = False) -> LoadedModel:
    """A machine that was identified as a model, for the whole workspace where its region is not known."""
    nominal, card = machine.nominal, {"columns": machine.columns, "joint_map": machine.joint_map}

    def made() -> Compensator:
        try:
            # The workspace has its own ends, records have not.
            margin = {} if len(machine.joints) or len(machine.beside) else {"margin": 0.0}
            return machine_alone(rows_of(machine), machine.values, machine.acting, machine.covariates, **margin)
        except (InputError, MethodFailedError) as reason:
            raise ModelFileError(f"{path}: {reason}") from None

    about = ({"mechanism": nominal.describe()}, nominal.joints, machine.covariates, nominal.pose)
    return LoadedModel(path, card, *about, made, None, machine, signed)


def load_geometry(path: str | Path, *, public_key: str | Path | None = None, allow_code: bool = False) -> LoadedModel:
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
        return model_of_machine(path, diagnosed, public_key is not None)
    file = _parsed(path, source, content)
    # Commands are of the machine, whatever it was seen through.
    nominal, identified = (inside(mechanism_of_file(file, what, allow_code)) for what in ("nominal", "value"))
    none = torch.zeros(0, 2, dtype=torch.float64)
    ends = [file.measured[j.name] for j in nominal.joints if j.name in file.measured]
    beside = torch.tensor(ends, dtype=torch.float64) if len(ends) == len(nominal.joints) else none
    about = (default_gravity(nominal), none, (), none, file.columns, file.joint_map, beside)
    machine = FoundMachine(nominal, identified.nominal, [], *about)
    return model_of_machine(path, machine, public_key is not None)


def load_machine(path: str | Path, *, allow_code: bool = False) -> Mechanism:
    """The machine of any file that a command writes, identified parameters as the nominal ones, without effects.

    Args, raises: as of `load_compensation`.
    """
    return load_compensation(path, allow_code=allow_code).identified(allow_code)


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
    if path.suffix.lower() in MACHINE_FORMS:
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
    if not source.is_file():
        raise ModelFileError(f"{path}: there is no such file; give the identified.yaml that ccnn identify writes")
    if file is None:
        raise ModelFileError(
            f"{path}: there is no identified machine; give the identified.yaml that ccnn identify writes, which holds "
            "the nominal parameters, too"
        )
    return file
