"""The compensator as `.pt2`: one step of the fixed point is traced, the others are copies of its nodes."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx import Graph, Node
from torch.fx import config as fx_config
from torch.fx.experimental.proxy_tensor import make_fx

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.export.export import verify
from ccnn_torch.compensation.model_files.onnx_session import METADATA_KEY, OUTPUTS, Array
from ccnn_torch.compensation.secant import Step, next_correction


class _Step(nn.Module):
    """One evaluation at joints - start, and what both directions take from it; what is traced."""

    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, ...]:
        """joints: `s x n` [SI]; covariates: `s x m` [SI], or None where there are none. Returns `OUTPUTS`."""
        own = self.compensator
        joints, covariates, strange = own._inputs(joints, covariates)
        # The deviation of the step before.
        command = joints - torch.zeros_like(joints)
        found = own._deviation(command, covariates, strange)
        back, inside = joints + found.value, found.excess.squeeze(-1) <= 0
        return command, found.value, found.inside, back, inside, own._sd(found)


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
    with _quiet():
        program = torch.export.export(_Step(compensator), example, dynamic_shapes=shapes)
    for node in program.graph.nodes:
        # Where in the source a step came from: paths of the machine that wrote the file.
        for key in ("stack_trace", "source_fn_stack", "nn_module_stack", "from_node", "torch_fn"):
            node.meta.pop(key, None)
    _unroll(program, compensator)
    module = program.module()

    def run(joints: Array, covariates: Array | None) -> dict[str, Array]:
        inputs = [torch.tensor(v) for v in (joints, covariates) if v is not None]
        with torch.no_grad():
            return {name: value.numpy() for name, value in zip(OUTPUTS, module(*inputs), strict=True)}

    verify(compensator, run, ".pt2")
    program.example_inputs = None
    stream = io.BytesIO()
    with _quiet():
        torch.export.save(program, stream, extra_files={METADATA_KEY: metadata})
    return stream.getvalue()


def _unroll(program: torch.export.ExportedProgram, compensator: Compensator) -> None:
    """Put further steps after the one that was traced, in place; the way back stays with the first."""
    graph = program.graph
    output = graph.output_node()
    outputs: Any = output.args[0]
    start = outputs[0].args[1]
    way_back = outputs[3:5]
    step = _between(graph, start, [node for node in outputs if node not in way_back])
    known: dict[Node, Node] = {start: start}
    value, correction, kept = outputs[1], start, list[Node]()
    buffers = program.graph_signature.inputs_to_buffers
    limit = next(node for node in graph.nodes if buffers.get(node.name) == "compensator.limit")
    with graph.inserting_before(output):
        for _ in range(compensator.iterations):
            found = known.get(value, value)
            if compensator.secant:
                correction, *kept = _advanced(graph, limit, found, correction, *kept)
            else:
                correction = found
            known = {start: correction}
            for node in step:
                known[node] = graph.node_copy(node, lambda n, known=known: known.get(n, n))
    output.args = (tuple(known.get(n, n) if n not in way_back else n for n in outputs),)
    for spec, node in zip(program.graph_signature.output_specs, output.args[0], strict=True):
        spec.arg.name = node.name
    graph.lint()
    program.graph_module.recompile()


def _advanced(graph: Graph, limit: Node, *given: Node) -> Sequence[Node]:
    """(δ, correction, numbers kept of the steps before) -> the next correction, and these with the new ones."""

    def function(limit: Tensor, found: Tensor, correction: Tensor, *numbers: Tensor) -> list[Tensor]:
        steps = [Step(*pair) for pair in zip(numbers[::2], numbers[1::2], strict=True)]
        correction, steps = next_correction(found, correction, steps, limit)
        return [correction, *(number for step in steps for number in step)]

    traced = make_fx(function)(*(node.meta["val"] for node in (limit, *given))).graph
    known = dict(zip(traced.find_nodes(op="placeholder"), (limit, *given), strict=True))
    for node in traced.nodes:
        if node.op == "call_function":
            known[node] = graph.node_copy(node, lambda n: known[n])
    outputs: Any = traced.output_node().args[0]
    return [known[node] for node in outputs]


def _between(graph: Graph, start: Node, ends: Sequence[Node]) -> list[Node]:
    """Nodes, in order, that lie between start and the ends."""
    behind, ahead = {start}, {*ends}
    nodes = [node for node in graph.nodes if node.op not in ("placeholder", "output")]
    for node in nodes:
        if not behind.isdisjoint(node.all_input_nodes):
            behind.add(node)
    for node in reversed(nodes):
        if node in ahead:
            ahead.update(node.all_input_nodes)
    return [node for node in nodes if node is not start and node in behind and node in ahead]


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter's progress, warnings and log lines from the user, here only.

    Nor does it look up where in the source a step came from: no file holds it, and it takes a tenth of the time.
    """
    loggers = [logging.getLogger(name) for name in ("torch", "torch.onnx", "torch.export", "torch.__trace")]
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
