"""A torch module as an ONNX graph, without what depends on the machine that writes it."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout

import onnx
import torch
from torch import Tensor, nn
from torch.fx import config as fx_config

from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY
from ccnn_torch.errors import MethodFailedError

__all__ = ["quiet_exporter", "to_onnx"]


def to_onnx(
    module: nn.Module | torch.export.ExportedProgram,
    example: tuple[Tensor, ...] | None,
    outputs: Sequence[str],
    opset: int,
    metadata: str,
    optimize: bool = True,
) -> onnx.ModelProto:
    """Export a module with its example inputs or a traced one, and leave out what depends on the machine.

    Args:
        optimize: let the exporter look for patterns, which takes minutes for the unrolled links of an arm and which
            ONNX Runtime does again when it loads the file.

    Raises:
        MethodFailedError: the exporter silently wrote another opset.
    """
    with quiet_exporter():
        program = torch.onnx.export(
            module,
            () if example is None else example,
            output_names=list(outputs),
            opset_version=opset,
            dynamo=True,
            external_data=False,
            verbose=False,
            optimize=optimize,
        )
    assert program is not None
    model = program.model_proto
    written = {entry.domain: entry.version for entry in model.opset_import}
    if written.get("") != opset:
        raise MethodFailedError(
            f"the exporter wrote ONNX opset {written.get('')} instead of {opset}; use a tested version of onnxscript"
        )
    for part in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        part.ClearField("doc_string")
        part.ClearField("metadata_props")
    for tensor in model.graph.initializer:
        tensor.ClearField("doc_string")
    for part in (*model.graph.input, *model.graph.output):
        for size in part.type.tensor_type.shape.dim:
            if size.dim_param:
                size.dim_param = "batch"
    # Inside, a length may be a multiple of the batch, and ONNX Runtime reuses memory of what bears the same name.
    for part in model.graph.value_info:
        for size in part.type.tensor_type.shape.dim:
            size.ClearField("dim_param")
    model.graph.name = "compensator"
    model.ClearField("doc_string")
    model.ClearField("metadata_props")
    model.metadata_props.add(key=METADATA_KEY, value=metadata)
    return model


@contextmanager
def quiet_exporter() -> Iterator[None]:
    """Keep the exporters' progress, warnings and log lines from the user, here only.

    Nor do they look up where in the source a step came from: no file holds it, and it takes a tenth of the time.
    """
    loggers = [
        logging.getLogger(name)
        for name in ("torch", "torch.onnx", "torch.export", "torch.__trace", "onnxscript", "onnx_ir")
    ]
    levels = [logger.level for logger in loggers]
    # Older versions of torch lack the switch, and setting it changes nothing.
    traces = getattr(fx_config, "do_not_emit_stack_traces", False)
    try:
        fx_config.do_not_emit_stack_traces = True
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        with warnings.catch_warnings(), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        fx_config.do_not_emit_stack_traces = traces
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
