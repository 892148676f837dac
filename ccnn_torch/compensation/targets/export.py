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
from ccnn_torch.compensation.targets.lowered import Found, Stack, with_readme
from ccnn_torch.compensation.targets.machines import print_hal, print_klipper
from ccnn_torch.compensation.targets.onnx_export import export_onnx
from ccnn_torch.compensation.targets.robots import (
    middle_of,
    offsets_alone,
    print_lerobot,
    print_pal,
    print_robot,
    print_ros2_control,
    print_ur,
)
from ccnn_torch.compensation.targets.structured_text import print_structured_text
from ccnn_torch.compensation.targets.table import print_tables
from ccnn_torch.display import plain
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.spelling import hint
from ccnn_torch.version import __version__

DTYPES = ("float64", "float32")
# What a controller needs: without the way back and the standard deviation a graph takes three quarters of the time.
COMMAND = ("command", "deviation", "inside_domain", "status")


@dataclass
class _Order:
    """What is to be exported, and how; the parts that targets need are made when they ask."""

    path: Path
    model: LoadedModel
    dtype: str
    sd: bool
    allow_code: bool
    current: Path | None = None
    said: str = ""

    def written(self, make: Callable[[Found], Stack], title: str) -> dict[str, str]:
        """Numbers of a stack with their README.md."""
        found = self.found
        files, self.said = with_readme(make(found), found, f"{title} of {plain(found.nominal.name)}")
        return files

    @property
    def found(self) -> Found:
        return Found(self.model, self.current, self.allow_code)

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

    def mechanism(self, corrected: bool) -> Mechanism:
        if corrected and self.model.machine is not None:
            return self.model.machine.identified
        if "spec" not in self.model.facts["mechanism"]:
            raise ModelFileError(f"{self.path}: this target needs the machine's kinematics, which the model lacks")
        return self.model.mechanism(self.allow_code)


def _linuxcnc(order: _Order) -> dict[str, str]:
    machine = order.model.machine
    # What acts beside a geometry no parameter of the kinematics holds.
    form = order.proven()[0] if machine is None or machine.acting else None
    return print_linuxcnc(form, order.mechanism(form is None), order.source())


def _onnx(order: _Order) -> dict[str, bytes | str]:
    compensator, model = order.compensator(), order.model
    fields = model.card
    if model.machine is not None:
        # Nothing was measured for this file but what identified the machine.
        digest = sha256(order.path.read_bytes()).hexdigest()
        fields = model.facts | fields | {"metrics": {}, "data_sha256": digest, "seed": 0}
    contents = model_contents(compensator, fields, forms=("onnx", "float32.onnx"))
    return dict(contents.values()) | {"controller.onnx": export_onnx(compensator, "{}", COMMAND)}


def _table(order: _Order, mesh: bool = True) -> dict[str, str]:
    known = "spec" in order.model.facts["mechanism"]
    return print_tables(order.compensator(), order.model.mechanism(order.allow_code) if known else None, mesh)


def _ros2_control(order: _Order) -> Mapping[str, str]:
    if order.dtype != "float64":
        raise InputError("ros2_control computes in double; leave out --dtype float32")
    found = order.found
    offsets, said = offsets_alone(found)
    if offsets is not None:
        return order.written(lambda _: offsets, "Zeros of the joints")
    return print_ros2_control(*order.proven(), middle_of(found), said)


def _numbers(make: Callable[[Found], Stack], title: str) -> Callable[[_Order], Mapping[str, str]]:
    """The target of a stack that reads numbers of the machine alone."""
    return lambda order: order.written(make, title)


TARGETS: dict[str, Callable[[_Order], Mapping[str, str | bytes]]] = {
    "c99": lambda order: print_c99(*order.proven()),
    "st": lambda order: print_structured_text(*order.proven()),
    "linuxcnc": _linuxcnc,
    "onnx": _onnx,
    "ros2_control": _ros2_control,
    "table": _table,
    "beckhoff": lambda order: _table(order, mesh=False),
    "urdf": _numbers(print_robot, "Links"),
    "mjcf": _numbers(print_robot, "Links"),
    "ur": _numbers(print_ur, "Kinematics"),
    "pal": _numbers(print_pal, "Calibration"),
    "klipper": _numbers(print_klipper, "Kinematics"),
    "linuxcnc_hal": _numbers(print_hal, "Kinematics"),
    "lerobot": _numbers(print_lerobot, "Calibration"),
}
CURRENT = ("urdf", "mjcf", "ur", "pal", "lerobot", "klipper", "ros2_control")
"""Those that take names or numbers from the user's own file."""


def export_model(
    path: str | Path,
    to: str,
    out: str | Path,
    dtype: str = "float64",
    sd: bool = False,
    public_key: str | Path | None = None,
    allow_code: bool = False,
    current: str | Path | None = None,
    tell: Callable[[str], None] = lambda left: None,
) -> dict[str, Path]:
    """Write a model as source code, table or file of a controller, robot or simulator.

    Args:
        path: a .safetensors file, an identified.yaml or a diagnosis.json.
        to: a target of `TARGETS`, see `ccnn export --help`.
        out: folder; made where it is not there.
        dtype: `float64` or `float32`, in which the controller computes.
        sd: with a function for the standard deviation of the deviation.
        public_key, allow_code: as `load_model`.
        current: the user's own file of a stack, from which names and numbers are taken that a machine does not have.
        tell: is given what the files leave of the machine's error, where they do not hold all of the model.

    Returns:
        The files by name.

    Raises:
        InputError: the target or the type is unknown, or the current file is missing or of another form.
        ModelFileError: the file is no master of a model.
        MethodFailedError: the model cannot be expressed so, or single precision does not hold it.
        WriteError: a file cannot be written.
    """
    for value, known, what in ((to, [*TARGETS], "target"), (dtype, DTYPES, "dtype")):
        if value not in known:
            raise InputError(f"there is no {what} '{value}'; {hint(value, known)}")
    if current is not None and to not in CURRENT:
        raise InputError(f"--current: is read by the targets {', '.join(CURRENT)}, not by {to}; leave it out")
    model = load_compensation(path, public_key=public_key, allow_code=allow_code)
    order = _Order(Path(path), model, dtype, sd, allow_code, None if current is None else Path(current))
    folder = Path(out)
    # Printed before anything is written: a target may find that it lacks an operation.
    contents = TARGETS[to](order)
    for name, content in contents.items():
        write_whole(folder / name, content)
    if order.said:
        tell(order.said)
    return {name: folder / name for name in contents}
