"""A module of its own as an ONNX graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import onnx
import torch
from torch import Tensor

from ccnn_torch.compensation.targets.lowering import recorded
from ccnn_torch.compensation.targets.onnx_export import rows_apart_from
from ccnn_torch.compensation.targets.onnx_graph import Graph
from ccnn_torch.compensation.targets.onnx_operations import ByTensors


def to_onnx(module: torch.nn.Module, inputs: Mapping[str, Tensor], outputs: Sequence[str]) -> onnx.ModelProto:
    """In double, for any number of rows; inputs: name -> a row for an example, `1 x w` or more."""
    rows = rows_apart_from(module)
    graph = Graph(rows, 20)
    given = [graph.input(name, row.shape[1], "batch") for name, row in inputs.items()]
    found = ByTensors(graph).run(recorded(module, [row[:1].repeat(rows, 1) for row in inputs.values()]), given)
    return graph.model(dict(zip(outputs, found, strict=True)), "batch", "module")
