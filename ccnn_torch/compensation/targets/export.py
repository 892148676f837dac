"""From a model file to the files of a target, proven equal to the model before they are written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ccnn_torch.compensation.model_files.identified import load_compensation
from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.compensation.targets.c99 import print_c99
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.from_model import form_of
from ccnn_torch.compensation.targets.golden import Golden, golden_vectors, require_equal
from ccnn_torch.compensation.targets.structured_text import print_structured_text
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.files.write import write_whole
from ccnn_torch.spelling import nearest
from ccnn_torch.version import __version__

__all__ = ["DTYPES", "TARGETS", "export_model"]

TARGETS: dict[str, Callable[[Form, Golden], dict[str, str]]] = {"c99": print_c99, "st": print_structured_text}
DTYPES = ("float64", "float32")


def export_model(
    path: str | Path,
    to: str,
    out: str | Path,
    dtype: str = "float64",
    sd: bool = False,
    public_key: str | Path | None = None,
    allow_code: bool = False,
) -> dict[str, Path]:
    """Write a model as source code of a controller.

    Args:
        path: a .safetensors file.
        to: `c99` or `st` (IEC 61131-3 Structured Text).
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
    if not isinstance(model, LoadedModel):
        raise ModelFileError(
            f"{path}: identified geometry alone is solved by iteration until it converges, which a controller cannot; "
            "train with it (ccnn run … geometry=identify) and export that model.safetensors"
        )
    if model.compensator is None:
        raise ModelFileError(f"{path}: an export is made of the master; give the .safetensors beside it")
    form = form_of(model.compensator, dtype, sd)
    form.facts = [
        f"Compensation of the joints of {model.facts['mechanism'].get('name') or 'a machine'}, "
        f"written by ccnn_torch {__version__} from {Path(path).name}, SHA-256 {model.card['files'][Path(path).name]}."
    ]
    golden = golden_vectors(model.compensator, form)
    require_equal(form, golden)
    folder = Path(out)
    # Printed before anything is written: a target may find that it lacks an operation.
    contents = TARGETS[to](form, golden)
    for name, content in contents.items():
        write_whole(folder / name, content)
    return {name: folder / name for name in contents}
