"""A function of tensors as a graph of what it called, by running it once."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Node
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

# Torch makes several operations of these, which depend on how many rows there are; recorded they are one.
_LIBRARY = torch.library.Library("ccnn_torch", "DEF")  # type: ignore[no-untyped-call]


def _whole(function: Any, arguments: str) -> Any:
    """An operation of its own that does what a function does."""
    _LIBRARY.define(f"{function.__name__}({arguments}) -> Tensor")  # type: ignore[no-untyped-call]
    _LIBRARY.impl(function.__name__, function, "CompositeExplicitAutograd")  # type: ignore[no-untyped-call]
    return getattr(torch.ops.ccnn_torch, function.__name__).default


_MATMUL, _FINITE = _whole(torch.matmul, "Tensor a, Tensor b"), _whole(torch.isfinite, "Tensor a")
_KEPT: dict[Any, Any] = {
    torch.matmul: _MATMUL, Tensor.matmul: _MATMUL, Tensor.__matmul__: _MATMUL,
    torch.isfinite: _FINITE, Tensor.isfinite: _FINITE,
}  # fmt: skip


class _Whole(TorchFunctionMode):
    """Calls them as one operation."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        # A vector on the left has no place in the table of operations.
        whole = _KEPT[func] if func in _KEPT and args[0].dim() > 1 else func
        return whole(*args, **(kwargs or {}))


class _Recorder(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Runs what is called inside of it, and notes it.

    Not `make_fx`: it makes a model of the memory and a trace of the stack for each operation, and takes seven times
    as long; and it loads torch's compiler, 1.5 s of a process.
    """

    def __init__(self, inputs: Sequence[Tensor]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.graph, self.constants = Graph(), torch.nn.Module()
        # By identity, so the tensors are kept.
        self._nodes: dict[int, tuple[Node, Tensor]] = {}
        for i, tensor in enumerate(inputs):
            self._keep(self.graph.placeholder(f"input_{i}"), tensor)

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Else torch loads its compiler to keep it from compiling `__torch_dispatch__`."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        found = func(*args, **kwargs)
        node = self.graph.call_function(func, self.nodes_of(args), self.nodes_of(kwargs))
        if isinstance(found, Tensor):
            self._keep(node, found)
        else:
            for i, part in enumerate(found):
                self._keep(self.graph.call_function(operator.getitem, (node, i)), part)
        return found

    def nodes_of(self, values: Any) -> Any:
        """Nested values with nodes in the places of tensors; one that nothing here made is a constant."""
        return tree_map(lambda value: self._node(value) if isinstance(value, Tensor) else value, values)

    def _node(self, tensor: Tensor) -> Node:
        if id(tensor) not in self._nodes:
            name = f"constant_{len(self._nodes)}"
            self.constants.register_buffer(name, tensor.detach())
            self._keep(self.graph.get_attr(name), tensor)
        return self._nodes[id(tensor)][0]

    def _keep(self, node: Node, tensor: Tensor) -> None:
        node.meta["val"] = tensor
        self._nodes[id(tensor)] = node, tensor


def recorded(function: Callable[..., Tensor | Sequence[Tensor]], example: Sequence[Tensor]) -> GraphModule:
    """A function as its operations on tensors of the example's shapes, those that mutate as ones that do not."""
    recorder = _Recorder(example)
    with torch.no_grad():
        with recorder, _Whole():
            found = torch.func.functionalize(lambda *given: function(*given))(*example)
        recorder.graph.output(recorder.nodes_of(found))
    return GraphModule(recorder.constants, recorder.graph)
