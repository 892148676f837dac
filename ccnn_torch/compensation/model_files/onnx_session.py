"""Running ONNX files; `_export` verifies with what a user loads with."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import onnx
import onnxruntime
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as runtime

from ccnn_torch.errors import ModelFileError

Array = NDArray[Any]

# How sentences about a touched file end.
TAKE_AGAIN = "; take it again from where it was written"

METADATA_KEY = "ccnn_torch"
OUTPUTS = (
    *("command", "deviation", "inside_domain", "ideal", "ideal_inside_domain", "deviation_sd"),
    *("status", "ideal_status"),
)

# What a graph or a module of another kind than ours may raise. ONNX Runtime's errors have no common class.
RUN_ERRORS: tuple[type[Exception], ...] = (
    *(RuntimeError, ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, MemoryError),
    *(v for v in vars(runtime).values() if isinstance(v, type) and issubclass(v, Exception)),
)


def said(reason: Exception) -> str:
    """Message of such an error, short enough for a sentence: it contains names from the file."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(reason)).split())[:200] or type(reason).__name__


def check_graph(model: onnx.ModelProto) -> None:
    """Refuse what our exports do not have: other files, operators of other libraries, loops and branches.

    Raises:
        ModelFileError: names what it is.
    """
    if model.functions:
        raise ModelFileError(f"its graph has a function of its own ({model.functions[0].name})" + TAKE_AGAIN)
    for node in model.graph.node:
        if node.domain not in ("", "ai.onnx"):
            raise ModelFileError(f"its graph has an operator of another library ({node.domain})" + TAKE_AGAIN)
        if any(a.HasField("g") or a.graphs for a in node.attribute):
            raise ModelFileError(f"its graph has a loop or a branch ({node.op_type})" + TAKE_AGAIN)
    for tensor in _tensors(model.graph):
        if tensor.data_location == onnx.TensorProto.EXTERNAL or tensor.external_data:
            raise ModelFileError(f"its graph reads another file ('{tensor.name}' is stored outside)" + TAKE_AGAIN)


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    yield from graph.initializer
    sparse = [*graph.sparse_initializer]
    for attribute in (a for node in graph.node for a in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        sparse += [attribute.sparse_tensor, *attribute.sparse_tensors]
    for tensor in sparse:
        yield from (tensor.values, tensor.indices)


def open_onnx(content: bytes) -> onnxruntime.InferenceSession:
    """A session on one thread: for one command, more only add jitter."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # Not by what the bytes look like.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    # Else it prints what is wrong with a file, and tries the same again.
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], enable_fallback=0)


def run_onnx(session: onnxruntime.InferenceSession, joints: Array, covariates: Array | None) -> dict[str, Array]:
    """joints: `s x n`; covariates: `s x m` or None; returns the outputs by name."""
    feeds = {"joints": joints} if covariates is None else {"joints": joints, "covariates": covariates}
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds), strict=True))
