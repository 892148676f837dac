"""Operations as nodes of an ONNX graph; linear ones stay linear forms as long as nobody needs their numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from onnx import TensorProto
from torch import Tensor
from torch.fx import Node

from ccnn_torch.compensation.targets.lowering import Lowering, operation_of
from ccnn_torch.compensation.targets.onnx_graph import Graph, Value, batch_of
from ccnn_torch.errors import MethodFailedError

_NAMES = {
    name: name.capitalize()
    for name in (
        "add", "sub", "mul", "div", "neg", "abs", "exp", "log", "sin", "cos", "tan", "tanh", "asin", "acos", "atan",
        "sqrt", "floor", "pow", "min", "max", "and", "or", "not", "sigmoid",
    )
}  # fmt: skip
_NAMES |= {"lt": "Less", "le": "LessOrEqual", "eq": "Equal", "select": "Where"}
_REDUCTIONS = {"add": "ReduceSum", "max": "ReduceMax", "min": "ReduceMin", "or": "ReduceMax", "and": "ReduceMin"}


class ByTensors(Lowering):
    """Into a graph."""

    native: ClassVar[Mapping[str, str]] = {
        "sigmoid": "sigmoid", "relu": "Relu", "reciprocal": "Reciprocal", "sign": "Sign",
    }  # fmt: skip

    def __init__(self, graph: Graph) -> None:
        self.graph = graph

    def is_value(self, value: Any) -> bool:
        return isinstance(value, Value)

    def is_truth(self, value: Any) -> bool:
        return self.graph.is_truth(value)

    def each(self, op: str, *operands: Any) -> Any:
        linear = {"add": self._sum, "sub": self._sum, "mul": self._scaled, "div": self._scaled}
        if op == "sigmoid" and self.graph.kind == TensorProto.DOUBLE:
            # In half the time, and linear before and after it.
            curve = self._node("Tanh", self.each("mul", operands[0], 0.5))
            return self.each("add", self.each("mul", curve, 0.5), 0.5)
        if op == "neg":
            found = self.graph.scaled(operands[0], -1.0)
        else:
            found = linear[op](op, *operands) if op in linear else None
        if found is not None:
            return found
        if op == "select":
            return self._selected_by(*operands)
        if op not in _NAMES and op not in self.native.values():
            raise MethodFailedError(f"the model needs '{op}', which ONNX does not have; leave that part of it out")
        return self._node(_NAMES.get(op, op), *operands)

    def reduced(self, op: str, value: Value, dims: list[int], keep: bool) -> Value:
        graph = self.graph
        solid, axes = graph.full(value), sorted(dims)
        shape = [1 if k in axes else n for k, n in enumerate(solid.shape) if keep or k not in axes]
        if op == "add" or graph.opset >= 18:
            names = [solid.name, graph.whole(axes)]
            return graph.node(_REDUCTIONS[op], names, shape, shape, keepdims=int(keep))
        return graph.node(_REDUCTIONS[op], [solid.name], shape, shape, keepdims=int(keep), axes=axes)

    def product(self, a: Any, b: Any) -> Value:
        graph = self.graph
        if isinstance(a, Value) and isinstance(b, Tensor):
            form = graph.times(a, b)
            if form is not None:
                return form
        shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2]) if min(len(a.shape), len(b.shape)) > 1 else ()
        left, right = (graph.full(v) if isinstance(v, Value) else v for v in (a, b))
        whole = (*shape, *a.shape[-2:-1], *b.shape[-1:]) if len(b.shape) > 1 else tuple(a.shape[:-1])
        names = [v.name if isinstance(v, Value) else graph.constant(graph.thin(v)) for v in (left, right)]
        return graph.node("MatMul", names, whole, whole)

    def picked(self, value: Any, dim: int, places: Tensor) -> Any:
        if isinstance(value, Tensor):
            return value.index_select(dim, places)
        graph, shape = self.graph, [*value.shape]
        shape[dim] = len(places)
        if len(places) == value.shape[dim] and torch.equal(places, torch.arange(len(places))):
            return value
        if dim == 1 and len(value.shape) == 2:
            form = graph.times(value, torch.eye(value.shape[1], dtype=torch.float64)[:, places])
            if form is not None:
                return form
        solid = graph.full(value)
        step = int(places[1] - places[0]) if len(places) > 1 else 1
        if len(places) and step > 0 and torch.equal(places, int(places[0]) + step * torch.arange(len(places))):
            limits = (int(places[0]), int(places[-1]) + 1, dim, step)
            names = [graph.whole([v]) for v in limits]
            return graph.node("Slice", [solid.name, *names], shape, shape)
        return graph.node("Gather", [solid.name, graph.whole(places.tolist())], shape, shape, axis=dim)

    def moved(self, node: Node, args: Any, kwargs: Any) -> Any:
        name, (value, *rest) = operation_of(node), args

        def change(tensor: Tensor) -> Any:
            return node.target(tensor, *rest, **kwargs)  # type: ignore[operator]

        if name == "squeeze":
            return self._shaped(change, value, rest[0] % len(value.shape))
        if name in _SHAPED:
            return self._shaped(change, value if name == "unsqueeze" else self.graph.full(value))
        if name in _PERMUTED:
            return self._permuted(change, value)
        if name in _PICKED:
            return self._parts(change, value)
        return _MOVES[name](self, *args, **kwargs) if name in _MOVES else None

    def clamped(self, value: Any, low: Any = None, high: Any = None, **named: Any) -> Any:
        low, high = named.get("min", low), named.get("max", high)
        if low is None or high is None or isinstance(low, Tensor | Value):
            return super().clamped(value, low, high)
        solid = self.graph.solid(value)
        limits = [self.graph.constant(torch.tensor(float(v), dtype=torch.float64)) for v in (low, high)]
        return self.graph.node("Clip", [solid.name, *limits], solid.shape, solid.real)

    def _node(self, op: str, *operands: Any, whole: bool = False) -> Value:
        """A node for operands that broadcast; constants among them are whole numbers if `whole`."""
        found = [self._operand(v, whole) for v in operands]
        shape = np.broadcast_shapes(*(v.shape for v in operands if isinstance(v, Value | Tensor)))
        real = np.broadcast_shapes(*(real for _, real in found))
        return self.graph.node(op, [name for name, _ in found], shape, (1,) * (len(shape) - len(real)) + tuple(real))

    def _operand(self, value: Any, whole: bool) -> tuple[str, tuple[int, ...]]:
        """Name and real shape of a value or a constant."""
        if isinstance(value, Value):
            solid = self.graph.solid(value)
            return solid.name, solid.real
        thin = self.graph.thin(value if isinstance(value, Tensor) else torch.tensor(float(value), dtype=torch.float64))
        thin = thin if thin.dtype == torch.bool else thin.to(torch.int64 if whole else torch.float64)
        while thin.dim() and thin.shape[0] == 1:
            thin = thin[0]
        return self.graph.constant(thin), tuple(thin.shape)

    def _cast_to(self, value: Value, kind: int) -> Value:
        return self.graph.node("Cast", [value.name], value.shape, value.real, to=kind)

    def _sum(self, op: str, a: Any, b: Any) -> Value | None:
        first, second = (a, b) if isinstance(a, Value) else (b, a)
        if op == "sub":
            # One of them with the other sign.
            negated = self.graph.scaled(b, -1.0) if isinstance(b, Value) else -torch.as_tensor(b)
            first, second = (a, negated) if isinstance(a, Value) else (negated, a)
        return None if first is None or second is None else self.graph.plus(first, second)

    def _scaled(self, op: str, a: Any, b: Any) -> Value | None:
        if (isinstance(a, Value) and isinstance(b, Value)) or (op == "div" and not isinstance(a, Value)):
            return None
        value, factor = (a, b) if isinstance(a, Value) else (b, a)
        factor = torch.as_tensor(factor, dtype=torch.float64)
        return self.graph.scaled(value, factor if op == "mul" else 1 / factor)

    def _selected_by(self, condition: Any, a: Any, b: Any) -> Value:
        constant = isinstance(condition, Tensor) and bool(condition.all())
        if constant and isinstance(a, Value) and condition.dim() == len(a.shape):
            return a
        one, other = _alike(a), _alike(b)
        if (
            one is not None
            and other is not None
            and isinstance(condition, Value)
            and self.graph.kind == TensorProto.DOUBLE
        ):
            # A cast takes a quarter of the time of a choice, and is part of linear forms.
            if {one, other} == {0, 1} and self.graph.is_whole(a) and self.graph.is_whole(b):
                return self._cast_to(condition if one else self._node("Not", condition), TensorProto.INT64)
            if not self.graph.is_whole(a):
                truth = self._cast_to(condition, self.graph.kind)
                made: Value = self.each("add", self.each("mul", truth, one - other), other)
                return made
        return self._node("Where", condition, a, b, whole=self.graph.is_whole(a) and self.graph.is_whole(b))

    # What only moves elements.

    def _shaped(self, change: Callable[[Tensor], Tensor], value: Value, less: int | None = None) -> Value:
        """Of another shape, as torch makes one out of it; less: the one axis that it then lacks."""
        solid = self.graph.solid(value)
        shape, real = (tuple(change(torch.empty(n, device="meta")).shape) for n in (solid.shape, solid.real))
        if shape == solid.shape:
            return solid
        if less is not None:
            return self.graph.node("Squeeze", [solid.name, self.graph.whole([less])], shape, real)
        sizes = self.graph.whole(batch_of(real, self.graph.rows))
        return self.graph.node("Reshape", [solid.name, sizes], shape, real)

    def _permuted(self, change: Callable[[Tensor], Tensor], value: Value) -> Value:
        solid = self.graph.solid(value)
        # Lengths that tell the axes apart.
        order = [n - 2 for n in change(torch.empty([k + 2 for k in range(len(solid.shape))], device="meta")).shape]
        shape, real = ([sizes[d] for d in order] for sizes in (solid.shape, solid.real))
        return self.graph.node("Transpose", [solid.name], shape, real, perm=order)

    def _parts(self, change: Callable[[Tensor], Any], value: Value) -> Any:
        """Elements along each axis: which they are is seen by what becomes of their numbers."""
        found: list[Any] = []
        for dim, length in enumerate(value.shape):
            at = torch.arange(length).reshape(-1, *[1] * (len(value.shape) - dim - 1)).expand(value.shape)
            moved = change(at)
            several = isinstance(moved, list | tuple)
            each = moved if several else [moved]
            places = [part.movedim(dim, 0).flatten(1)[:, 0] if part.dim() > 1 else part for part in each]
            found = [self.picked(v, dim, p) for v, p in zip(found or [value] * len(each), places, strict=True)]
        return found if several else found[0]

    def _selected(self, value: Value, dim: int, index: int) -> Value:
        solid = self.graph.full(value)
        dim %= len(solid.shape)
        shape = [n for k, n in enumerate(solid.shape) if k != dim]
        at = self.graph.whole(index % solid.shape[dim])
        return self.graph.node("Gather", [solid.name, at], shape, shape, axis=dim)

    def _joined(self, parts: Sequence[Any], dim: int = 0) -> Value:
        graph, rank = self.graph, len(parts[0].shape)
        dim %= rank
        parts = [p for p in parts if p.shape[dim]]
        if len(parts) == 1 and isinstance(parts[0], Value):
            return parts[0]
        form = graph.beside(parts) if rank == 2 and dim == 1 else None
        if form is not None:
            return form
        solids = [graph.full(p) if isinstance(p, Value) else graph.filled(p) for p in parts]
        shape = [sum(s.shape[dim] for s in solids) if k == dim else n for k, n in enumerate(solids[0].shape)]
        return graph.node("Concat", [s.name for s in solids], shape, shape, axis=dim)

    def _stacked(self, parts: Sequence[Any], dim: int = 0) -> Value:
        dim %= len(parts[0].shape) + 1
        ahead = [
            self._shaped(lambda v: v.unsqueeze(dim), p) if isinstance(p, Value) else p.unsqueeze(dim) for p in parts
        ]
        return self._joined(ahead, dim)

    def _expanded(self, value: Value, shape: Sequence[int]) -> Value:
        solid = self.graph.solid(value)
        more = len(shape) - len(solid.shape)
        wanted = tuple(solid.shape[k - more] if n == -1 else n for k, n in enumerate(shape))
        # So that names and shapes agree in rank.
        solid = self._shaped(lambda v: v.reshape(*[1] * more, *v.shape), solid)
        return Value(wanted, solid.name, solid.real)

    def _unbound(self, value: Value, dim: int = 0) -> list[Value]:
        return [self._selected(value, dim, k) for k in range(value.shape[dim])]


def _alike(value: Any) -> float | None:
    """The number that all elements of a constant are; None where they are several."""
    if isinstance(value, Value):
        return None
    flat = torch.as_tensor(value).flatten()
    return flat[0].item() if len(flat) and bool((flat == flat[0]).all()) else None


_SHAPED, _PERMUTED = (
    frozenset({"view", "_unsafe_view", "unsqueeze", "squeeze"}),
    frozenset({"permute", "transpose", "t"}),
)
_PICKED = frozenset({"slice", "index", "index_select", "flip", "split", "split_with_sizes"})
_MOVES: dict[str, Callable[..., Any]] = {
    "select": ByTensors._selected, "cat": ByTensors._joined, "stack": ByTensors._stacked,
    "expand": ByTensors._expanded, "unbind": ByTensors._unbound,
}  # fmt: skip
