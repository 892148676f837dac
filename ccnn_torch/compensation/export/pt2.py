"""The compensator as `.pt2`: one step of the fixed point is traced, the others are copies of its nodes."""

from __future__ import annotations

import copy
import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx import Node
from torch.fx import config as fx_config

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.export.export import verify
from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY, OUTPUTS, Array

__all__ = ["export_pt2", "quiet_exporter"]


class _Graph(nn.Module):
    """Both directions as named outputs; what is traced."""

    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, ...]:
        """joints: `s x n` [SI]; covariates: `s x m` [SI], or None where there are none. Returns `OUTPUTS`."""
        return tuple(self.compensator.solve(joints, covariates))


def export_pt2(compensator: Compensator, metadata: str) -> bytes:
    """The compensator in float64 as a verified `torch.export` file; inputs, outputs and errors as `export_onnx`.

    Nothing in the file is pickled: it carries no example inputs, which are the one thing torch would pickle here. What
    is verified is the program that is written, since opening such a file can run code that it contains.
    """
    batch = torch.export.Dim("batch")
    n = len(compensator.joints)
    points = compensator.domain.centre.repeat(3, 1)
    example = (points[:, :n].contiguous(), points[:, n:].contiguous())[: 2 if compensator.covariates else 1]
    shapes = {name: {0: batch} for name, _ in zip(("joints", "covariates"), example, strict=False)}
    traced = copy.copy(compensator)
    # Further steps are copies of the first.
    traced.iterations = 1
    with quiet_exporter():
        program = torch.export.export(_Graph(traced), example, dynamic_shapes=shapes)
    for node in program.graph.nodes:
        # Where in the source a step came from: paths of the machine that wrote the file.
        for key in ("stack_trace", "source_fn_stack", "nn_module_stack", "from_node", "torch_fn"):
            node.meta.pop(key, None)
    outputs: Any = program.graph.output_node().args[0]
    found = dict(zip(OUTPUTS, outputs, strict=True))
    _unroll(program, found["ideal"].args[1], found["deviation"], compensator.iterations)
    module = program.module()

    def run(joints: Array, covariates: Array | None) -> dict[str, Array]:
        inputs = [torch.tensor(v) for v in (joints, covariates) if v is not None]
        with torch.no_grad():
            return {name: value.numpy() for name, value in zip(OUTPUTS, module(*inputs), strict=True)}

    verify(compensator, run, ".pt2")
    program.example_inputs = None
    stream = io.BytesIO()
    with quiet_exporter():
        torch.export.save(program, stream, extra_files={METADATA_KEY: metadata})
    return stream.getvalue()


def _unroll(program: torch.export.ExportedProgram, start: Node, end: Node, times: int) -> None:
    """Make a program with one step one of several, in place.

    Args:
        program: it computes `end` from `start` by one step.
        start, end: nodes.
        times: steps wanted, at least 1.
    """
    graph = program.graph
    nodes = [node for node in graph.nodes if node.op not in ("placeholder", "output")]
    before, step, _ = _parts([node.all_input_nodes for node in nodes], [[node] for node in nodes], start, end)
    first = nodes[step[0]]
    for k in before:
        if k > step[0]:
            first.prepend(nodes[k])
    value = start
    for _ in range(1, times):
        renamed: dict[Node, Node] = {start: value}
        with graph.inserting_before(first):
            for k in step:
                renamed[nodes[k]] = graph.node_copy(nodes[k], lambda n, known=renamed: known.get(n, n))
        value = renamed[end]
    for k in step:
        nodes[k].replace_input_with(start, value)
    graph.lint()
    program.graph_module.recompile()


def _parts(
    inputs: Sequence[Sequence[Any]], outputs: Sequence[Sequence[Any]], start: Any, end: Any
) -> tuple[list[int], list[int], list[int]]:
    """Nodes, in order, that the step needs; that lie between start and end; and all others."""
    behind = {start}
    for taken, made in zip(inputs, outputs, strict=True):
        if not behind.isdisjoint(taken):
            behind.update(made)
    ahead = {end}
    for taken, made in zip(reversed(inputs), reversed(outputs), strict=True):
        if not ahead.isdisjoint(made):
            ahead.update(taken)
    parts: tuple[list[int], list[int], list[int]] = ([], [], [])
    for k, made in enumerate(outputs):
        needed = not ahead.isdisjoint(made)
        parts[2 if not needed else 1 if start not in made and not behind.isdisjoint(made) else 0].append(k)
    assert parts[1], "the end does not come from the start"
    return parts


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
