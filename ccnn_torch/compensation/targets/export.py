"""From a model file to the files of a target, proven equal to the model before they are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.model_files.load import LoadedModel, load_compensation
from ccnn_torch.compensation.model_files.save import model_contents
from ccnn_torch.compensation.targets.c99 import print_c99
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.from_model import form_of
from ccnn_torch.compensation.targets.golden import Golden, golden_vectors, require_equal
from ccnn_torch.compensation.targets.linuxcnc import print_linuxcnc
from ccnn_torch.compensation.targets.onnx_export import export_onnx
from ccnn_torch.compensation.targets.structured_text import print_structured_text
from ccnn_torch.compensation.targets.table import print_tables
from ccnn_torch.errors import InputError, MethodFailedError, ModelFileError
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms import Mechanism, SerialArm, mechanism_from_description
from ccnn_torch.mechanisms.mechanism_file import dh_text, mjcf_text, urdf_text
from ccnn_torch.spelling import nearest
from ccnn_torch.version import __version__

DTYPES = ("float64", "float32")
# What a controller needs: without the way back and the standard deviation a graph takes three quarters of the time.
COMMAND = ("command", "deviation", "inside_domain", "status")


def print_robot(model: LoadedModel) -> dict[str, str]:
    """Contents of the files by name: `robot.urdf`, `robot.xml` (MJCF), and `robot.yaml` where the arm has a DH table.

    Raises:
        MethodFailedError: the model has no identified links, or its machine is no serial arm.
    """
    arm = _arm(model)
    if arm.drives:
        raise MethodFailedError(
            f"a URDF has no key for the leads and couplings of '{arm.name}'; export c99, st or onnx"
        )
    texts = {"robot.urdf": urdf_text(arm), "robot.xml": mjcf_text(arm)}
    return texts if arm.convention == "urdf" else texts | {"robot.yaml": dh_text(arm)}


def _arm(model: LoadedModel) -> SerialArm:
    if model.machine is not None:
        arm = model.machine.identified
        if isinstance(arm, SerialArm):
            return arm
        raise MethodFailedError(
            f"a URDF is a tree, and '{arm.name}' is no serial arm; its parameters are in identified.yaml"
        )
    machine = None if model.compensator is None else model.compensator.machine
    if machine is None or not isinstance(machine.mechanism, SerialArm):
        raise MethodFailedError(
            "this model has no identified links of an arm to write; train with geometry=identify, or give the "
            "identified.yaml of ccnn identify"
        )
    arm = machine.real
    assert isinstance(arm, SerialArm)
    return arm


@dataclass
class _Order:
    """What is to be exported, and how; the parts that targets need are made when they ask."""

    path: Path
    model: LoadedModel
    dtype: str
    sd: bool
    allow_code: bool

    def compensator(self) -> Compensator:
        if self.model.compensator is None:
            raise ModelFileError(f"{self.path}: an export is made of the master; give the .safetensors beside it")
        return self.model.compensator

    def proven(self) -> tuple[Form, Golden]:
        compensator = self.compensator()
        form = form_of(compensator, self.dtype, self.sd)
        form.facts = [f"Compensation of the joints of {self.source()}."]
        if self.model.joint_map:
            counted = ", ".join(f"{joint} = {text}" for joint, text in self.model.joint_map.items())
            form.facts.append(f"Joints are the mechanism's; of what the controller shows they are {counted}.")
        golden = golden_vectors(compensator, form)
        require_equal(form, golden)
        return form, golden

    def source(self) -> str:
        name, file = self.model.facts["mechanism"].get("name") or "a machine", self.path.name
        told = f"{name}, written by ccnn_torch {__version__} from {file}"
        if self.model.machine is None:
            return f"{told}, SHA-256 {self.model.card['files'][file]}"
        return told

    def mechanism(self) -> Mechanism:
        if self.model.machine is not None:
            return self.model.machine.identified
        described = self.model.facts["mechanism"]
        if "spec" not in described:
            raise ModelFileError(f"{self.path}: this target needs the machine's kinematics, which the model lacks")
        return mechanism_from_description(described, self.allow_code)


def _linuxcnc(order: _Order) -> dict[str, str]:
    form = order.proven()[0] if order.model.machine is None else None
    return print_linuxcnc(form, order.mechanism(), order.source())


def _onnx(order: _Order) -> dict[str, bytes | str]:
    compensator, model = order.compensator(), order.model
    fields = model.card
    if model.machine is not None:
        # Nothing was measured for this file but what identified the machine.
        digest = sha256(order.path.read_bytes()).hexdigest()
        fields = model.facts | fields | {"metrics": {}, "data_sha256": digest, "seed": 0}
    contents = model_contents(compensator, fields, forms=("onnx", "float32.onnx"))
    return dict(contents.values()) | {"controller.onnx": export_onnx(compensator, "{}", COMMAND)}


def _table(order: _Order) -> dict[str, str]:
    if order.model.machine is not None:
        return print_tables(order.compensator(), order.model.machine.nominal)
    known = "spec" in order.model.facts["mechanism"]
    return print_tables(order.compensator(), order.mechanism() if known else None)


TARGETS: dict[str, Callable[[_Order], Mapping[str, str | bytes]]] = {
    "c99": lambda order: print_c99(*order.proven()),
    "st": lambda order: print_structured_text(*order.proven()),
    "linuxcnc": _linuxcnc,
    "onnx": _onnx,
    "urdf": lambda order: print_robot(order.model),
    "table": _table,
}


def export_model(
    path: str | Path,
    to: str,
    out: str | Path,
    dtype: str = "float64",
    sd: bool = False,
    public_key: str | Path | None = None,
    allow_code: bool = False,
) -> dict[str, Path]:
    """Write a model as source code, table or file of a controller or simulator.

    Args:
        path: a .safetensors file, or an identified.yaml.
        to: `c99`, `st` (IEC 61131-3 Structured Text), `linuxcnc` (kinematics component), `onnx`, `urdf` (with MuJoCo
            model and DH table), or `table` (error tables).
        out: folder; made where it is not there.
        dtype: `float64` or `float32`, in which the controller computes.
        sd: with a function for the standard deviation of the deviation.
        public_key, allow_code: as `load_model`.

    Returns:
        The files by name.

    Raises:
        InputError: the target or the type is unknown.
        ModelFileError: the file is no master of a model.
        MethodFailedError: the model cannot be expressed so, or single precision does not hold it.
        WriteError: a file cannot be written.
    """
    for value, known, what in ((to, [*TARGETS], "target"), (dtype, DTYPES, "dtype")):
        if value not in known:
            near = nearest(value, known)
            hint = f" (did you mean '{near}'?)" if near else ""
            raise InputError(f"there is no {what} '{value}'{hint}; there are {', '.join(known)}")
    model = load_compensation(path, public_key=public_key, allow_code=allow_code)
    order = _Order(Path(path), model, dtype, sd, allow_code)
    folder = Path(out)
    # Printed before anything is written: a target may find that it lacks an operation.
    contents = TARGETS[to](order)
    for name, content in contents.items():
        write_whole(folder / name, content)
    return {name: folder / name for name in contents}
