"""Running exported files; `_export` verifies with what a user loads with."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import ModelFileError

__all__ = [
    "METADATA_KEY",
    "OUTPUTS",
    "TAKE_AGAIN",
    "Array",
    "open_onnx",
    "open_pt2",
    "read_pt2_text",
    "run_onnx",
    "run_pt2",
]

Array = NDArray[Any]

# How sentences about a touched file end.
TAKE_AGAIN = "; take it again from where it was written"

METADATA_KEY = "ccnn_torch"
OUTPUTS = ("command", "deviation", "inside_domain", "ideal", "ideal_inside_domain", "deviation_sd")


def open_onnx(content: bytes) -> onnxruntime.InferenceSession:
    """A session on one thread: for one command, more only add jitter."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def run_onnx(session: onnxruntime.InferenceSession, joints: Array, covariates: Array | None) -> dict[str, Array]:
    """joints: `s x n`; covariates: `s x m` or None; returns the outputs by name."""
    feeds = {"joints": joints} if covariates is None else {"joints": joints, "covariates": covariates}
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, feeds), strict=True))


def open_pt2(content: bytes) -> torch.export.ExportedProgram:
    """The program in a `.pt2` file.

    Raises:
        ModelFileError: something in it would go through pickle; our own files hold nothing of the kind.
    """
    with _archive(content) as archive:
        _refuse_pickle(archive)
    return torch.export.load(io.BytesIO(content))


def read_pt2_text(content: bytes) -> str | None:
    """Our JSON in a `.pt2` file, None where there is none.

    Raises:
        ModelFileError: it is no such file, or damaged.
    """
    with _archive(content) as archive:
        for name in archive.namelist():
            if name.endswith(f"/extra/{METADATA_KEY}"):
                return archive.read(name).decode()
    return None


def run_pt2(module: Callable[..., tuple[Tensor, ...]], joints: Array, covariates: Array | None) -> dict[str, Array]:
    """As `run_onnx`."""
    inputs = [torch.tensor(v) for v in (joints, covariates) if v is not None]
    with torch.no_grad():
        return {name: value.numpy() for name, value in zip(OUTPUTS, module(*inputs), strict=True)}


def _archive(content: bytes) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(io.BytesIO(content))
    except zipfile.BadZipFile:
        raise ModelFileError("it is damaged, or no .pt2 file" + TAKE_AGAIN) from None


def _refuse_pickle(archive: zipfile.ZipFile) -> None:
    """torch.export.load unpickles example inputs, custom objects and tensors marked so; refuse a file that has any."""
    for name in archive.namelist():
        inner = name.split("/", 1)[-1]
        pickled = inner.startswith("data/sample_inputs/") and archive.getinfo(name).file_size > 0
        if inner.endswith("_config.json"):
            entries = json.loads(archive.read(name))["config"].values()
            pickled = any(e["use_pickle"] or not _plain(e["path_name"]) for e in entries)
        elif inner.startswith(("data/weights/", "data/constants/")):
            pickled = not _plain(inner.rsplit("/", 1)[-1])
        if pickled:
            raise ModelFileError(f"it holds pickled data ({inner}), which is never loaded" + TAKE_AGAIN)


def _plain(name: str) -> bool:
    return name.startswith(("weight_", "tensor_"))
