"""The fixed point's steps in an exported graph: one is traced and converted, the others are copies of its nodes.

Tracing and converting the links of an arm sixteen times takes more than a minute; copying nodes takes none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import onnx
import torch
from onnx import NodeProto
from torch.fx import Node

__all__ = ["unroll_onnx", "unroll_program"]


def unroll_onnx(model: onnx.ModelProto, start: str, end: str, times: int) -> None:
    """Make a graph with one step one of several, in place.

    Args:
        model: its graph computes the value `end` from the value `start` by one step.
        start, end: names of values.
        times: steps wanted, at least 1.
    """
    nodes = [*model.graph.node]
    before, step, after = _parts([[*node.input] for node in nodes], [[*node.output] for node in nodes], start, end)
    copies: list[NodeProto] = []
    inner = {name for k in step for name in nodes[k].output if name}
    value = start
    for number in range(1, times):
        renamed = {name: f"{name}_step{number}" for name in inner} | {start: value}
        for k in step:
            twin = NodeProto()
            twin.CopyFrom(nodes[k])
            twin.name = f"{twin.name}_step{number}"
            twin.input[:] = [renamed.get(name, name) for name in twin.input]
            twin.output[:] = [renamed.get(name, name) for name in twin.output]
            copies.append(twin)
        value = renamed[end]
    for k in step:
        nodes[k].input[:] = [value if name == start else name for name in nodes[k].input]
    ordered = [*(nodes[k] for k in before), *copies, *(nodes[k] for k in step), *(nodes[k] for k in after)]
    del model.graph.node[:]
    model.graph.node.extend(ordered)


def unroll_program(program: torch.export.ExportedProgram, start: Node, end: Node, times: int) -> None:
    """As `unroll_onnx`, of a traced program."""
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
