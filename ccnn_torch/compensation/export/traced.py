"""A torch function as nodes of an ONNX graph: traced once by running it, and written as often as it is called."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count
from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from ccnn_torch.compensation.export.graph import Graph
from ccnn_torch.compensation.export.operations import ByTensors

# Rows of an example, or a few more.
_LEAST = 61


def rows_apart_from(module: torch.nn.Module) -> int:
    """How many rows an example has, so that a length is a multiple of them only where it grows with the batch."""
    tensors = [*module.state_dict().values(), *module.buffers()]
    lengths = {n for tensor in tensors for n in tensor.shape if n}
    primes = (p for p in count(_LEAST) if all(p % d for d in range(2, math.isqrt(p) + 1)))
    return next(p for p in primes if all(n % p for n in lengths))


class Traced:
    """A function of tensors whose first axis is the batch."""

    def __init__(self, function: Callable[..., Any], *example: Tensor) -> None:
        with torch.no_grad():
            self._module = make_fx(lambda *given: function(*given), tracing_mode="real", pre_dispatch=True)(*example)

    def __call__(self, graph: Graph, *inputs: Any) -> list[Any]:
        """Write it into a graph; inputs and outputs are values or constants.

        Raises:
            MethodFailedError: there is an operation that no file has.
        """
        return ByTensors(graph).run(self._module, inputs)
