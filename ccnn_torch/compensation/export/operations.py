"""What each operation of torch is as nodes of an ONNX graph; constants among its operands are worked out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import Node
from torch.utils._pytree import tree_leaves

from ccnn_torch.compensation.export.graph import Graph, Value, batch_of
from ccnn_torch.errors import MethodFailedError

_SAME = frozenset({"lift_fresh_copy", "lift_fresh", "detach", "detach_", "alias", "clone", "contiguous"})
_UNARY = {
    "neg": "Neg", "abs": "Abs", "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos", "tan": "Tan", "tanh": "Tanh",
    "asin": "Asin", "acos": "Acos", "atan": "Atan", "sqrt": "Sqrt", "sigmoid": "Sigmoid", "relu": "Relu",
    "floor": "Floor", "reciprocal": "Reciprocal", "sign": "Sign", "softplus": "Softplus", "elu": "Elu", "erf": "Erf",
    "logical_not": "Not", "bitwise_not": "Not",
}  # fmt: skip
_BINARY = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "div": "Div", "maximum": "Max", "minimum": "Min", "lt": "Less",
    "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual", "eq": "Equal", "logical_and": "And",
    "bitwise_and": "And", "__and__": "And", "logical_or": "Or", "bitwise_or": "Or", "__or__": "Or",
}  # fmt: skip
_REDUCTIONS = {"sum": "ReduceSum", "mean": "ReduceMean", "amax": "ReduceMax", "amin": "ReduceMin"}
_FILLS = {"zeros_like": 0.0, "ones_like": 1.0, "new_zeros": 0.0, "new_ones": 1.0}


def write_operation(graph: Graph, node: Node, args: Any, kwargs: Any) -> Any:
    """What a traced operation gives, a value or a constant.

    Raises:
        MethodFailedError: no file has the operation.
    """
    name = node.target.__name__.partition(".")[0]  # type: ignore[union-attr]
    if not any(isinstance(v, Value) for v in tree_leaves((args, kwargs))):
        with torch.no_grad():
            return node.target(*args, **kwargs)  # type: ignore[operator]
    if name == "getitem":
        return args[0][args[1]]
    if name in _SAME:
        return args[0]
    if name in _UNARY and not kwargs and len(args) == 1:
        return _unary(graph, name, args[0])
    if name in _BINARY and not kwargs.get("rounding_mode"):
        alpha = kwargs.get("alpha", args[2] if len(args) > 2 else 1)
        return _binary(graph, name, args[0], args[1] if alpha == 1 else _binary(graph, "mul", args[1], alpha))
    if name in _REDUCTIONS:
        return _reduced(graph, _REDUCTIONS[name], *args, **{k: v for k, v in kwargs.items() if k in ("dim", "keepdim")})
    if name in _FILLS or name == "full_like":
        shape = args[0].shape if name.endswith("_like") else args[1]
        return torch.full(tuple(shape), float(args[1]) if name == "full_like" else _FILLS[name], dtype=torch.float64)
    written = _OTHERS.get(name)
    if written is None:
        raise MethodFailedError(f"the model needs '{name}', which no file has; leave that part of it out")
    return written(graph, *args, **{k: v for k, v in kwargs.items() if k not in ("dtype", "memory_format")})


def _rank(value: Value) -> int:
    return len(value.shape)


def _shape(value: Any) -> tuple[int, ...]:
    return tuple(value.shape) if isinstance(value, Value | Tensor) else ()


def _operand(graph: Graph, value: Any, whole: bool = False) -> tuple[str, tuple[int, ...]]:
    """Name and real shape of a value or a constant, a whole number if `whole`."""
    if isinstance(value, Value):
        solid = graph.solid(value)
        return solid.name, solid.real
    thin = graph.thin(value if isinstance(value, Tensor) else torch.tensor(float(value), dtype=torch.float64))
    thin = thin if thin.dtype == torch.bool else thin.to(torch.int64 if whole else torch.float64)
    while thin.dim() and thin.shape[0] == 1:
        thin = thin[0]
    return graph.constant(thin), tuple(thin.shape)


def _each(graph: Graph, op: str, *operands: Any, whole: bool = False) -> Value:
    """An operation on operands that broadcast; constants among them are whole numbers if `whole`."""
    found = [_operand(graph, v, whole) for v in operands]
    shape = np.broadcast_shapes(*map(_shape, operands))
    real = np.broadcast_shapes(*(real for _, real in found))
    return graph.node(op, [name for name, _ in found], shape, (1,) * (len(shape) - len(real)) + tuple(real))


def _unary(graph: Graph, name: str, value: Value) -> Value:
    if name == "neg":
        return graph.scaled(value, -1.0) or _each(graph, "Neg", value)
    return _each(graph, _UNARY[name], value)


def _binary(graph: Graph, name: str, a: Any, b: Any) -> Value:
    found = None
    if name in ("add", "sub"):
        first, second = (a, b) if isinstance(a, Value) else (b, a)
        if name == "sub":
            # One of them with the other sign.
            negated = graph.scaled(b, -1.0) if isinstance(b, Value) else -torch.as_tensor(b)
            first, second = (a, negated) if isinstance(a, Value) else (negated, a)
        found = None if first is None or second is None else graph.plus(first, second)
    elif name in ("mul", "div") and not (isinstance(a, Value) and isinstance(b, Value)):
        value, factor = (a, b) if isinstance(a, Value) else (b, a)
        if name == "mul" or isinstance(a, Value):
            factor = torch.as_tensor(factor, dtype=torch.float64)
            found = graph.scaled(value, factor if name == "mul" else 1 / factor)
    return found or _each(graph, _BINARY[name], a, b)


def _reduced(graph: Graph, op: str, value: Value, dim: Any = None, keepdim: bool = False) -> Value:
    solid = graph.full(value)
    rank = len(solid.shape)
    axes = sorted(d % rank for d in (range(rank) if dim is None else [dim] if isinstance(dim, int) else dim))
    shape = [1 if k in axes else n for k, n in enumerate(solid.shape) if keepdim or k not in axes]
    if op == "ReduceSum" or graph.opset >= 18:
        names = [solid.name, graph.constant(np.array(axes, np.int64))]
        return graph.node(op, names, shape, shape, keepdims=int(keepdim))
    return graph.node(op, [solid.name], shape, shape, keepdims=int(keepdim), axes=axes)


def _matmul(graph: Graph, a: Any, b: Any) -> Value:
    if isinstance(a, Value) and isinstance(b, Tensor):
        form = graph.times(a, b)
        if form is not None:
            return form
    shape = np.broadcast_shapes(_shape(a)[:-2], _shape(b)[:-2]) if min(len(_shape(a)), len(_shape(b))) > 1 else ()
    left, right = (graph.full(v) if isinstance(v, Value) else v for v in (a, b))
    whole = (*shape, *_shape(a)[-2:-1], *_shape(b)[-1:]) if len(_shape(b)) > 1 else _shape(a)[:-1]
    names = [v.name if isinstance(v, Value) else graph.constant(graph.thin(v)) for v in (left, right)]
    return graph.node("MatMul", names, whole, whole)


def _linear(graph: Graph, value: Any, weight: Any, bias: Any = None) -> Any:
    found = _matmul(graph, value, weight.mT)
    return found if bias is None else _binary(graph, "add", found, bias)


def _reshaped(graph: Graph, value: Value, shape: Sequence[int]) -> Value:
    shape, solid = [*shape], graph.full(value)
    if -1 in shape:
        shape[shape.index(-1)] = math.prod(solid.shape) // -math.prod(shape)
    sizes = graph.constant(np.array(batch_of(shape, graph.rows), np.int64))
    return graph.node("Reshape", [solid.name, sizes], shape, shape)


def _unsqueezed(graph: Graph, value: Value, dim: int) -> Value:
    solid = graph.solid(value)
    at = dim % (len(solid.shape) + 1)
    shape, real = ([*sizes[:at], 1, *sizes[at:]] for sizes in (solid.shape, solid.real))
    return graph.node("Unsqueeze", [solid.name, graph.constant(np.array([at], np.int64))], shape, real)


def _squeezed(graph: Graph, value: Value, dim: int) -> Value:
    if value.shape[dim] != 1:
        return value
    solid = graph.solid(value)
    at = dim % len(solid.shape)
    shape, real = ([*sizes[:at], *sizes[at + 1 :]] for sizes in (solid.shape, solid.real))
    return graph.node("Squeeze", [solid.name, graph.constant(np.array([at], np.int64))], shape, real)


def _permuted(graph: Graph, value: Value, order: Sequence[int]) -> Value:
    solid = graph.solid(value)
    order = [d % len(solid.shape) for d in order]
    shape, real = ([sizes[d] for d in order] for sizes in (solid.shape, solid.real))
    return graph.node("Transpose", [solid.name], shape, real, perm=order)


def _transposed(graph: Graph, value: Value, a: int = -2, b: int = -1) -> Value:
    order = [*range(len(value.shape))]
    order[a], order[b] = order[b], order[a]
    return _permuted(graph, value, order)


def _selected(graph: Graph, value: Value, dim: int, index: int) -> Value:
    solid = graph.full(value)
    dim %= len(solid.shape)
    shape = [n for k, n in enumerate(solid.shape) if k != dim]
    at = graph.constant(np.array(index % solid.shape[dim], np.int64))
    return graph.node("Gather", [solid.name, at], shape, shape, axis=dim)


def _picked(graph: Graph, value: Value, dim: int, places: Tensor) -> Value:
    """Elements along one axis."""
    dim %= len(value.shape)
    shape = [len(places) if k == dim else n for k, n in enumerate(value.shape)]
    if len(places) == value.shape[dim] and torch.equal(places, torch.arange(len(places))):
        return value
    if dim == 1 and len(value.shape) == 2:
        form = graph.times(value, torch.eye(value.shape[1], dtype=torch.float64)[:, places])
        if form is not None:
            return form
    solid = graph.full(value)
    step = int(places[1] - places[0]) if len(places) > 1 else 1
    if len(places) and step > 0 and torch.equal(places, int(places[0]) + step * torch.arange(len(places))):
        limits = [int(places[0]), int(places[-1]) + 1]
        names = [graph.constant(np.array([v], np.int64)) for v in (*limits, dim, step)]
        return graph.node("Slice", [solid.name, *names], shape, shape)
    return graph.node("Gather", [solid.name, graph.constant(places.numpy().astype(np.int64))], shape, shape, axis=dim)


def _sliced(graph: Graph, value: Value, dim: int = 0, start: Any = None, end: Any = None, step: int = 1) -> Value:
    return _picked(graph, value, dim, torch.arange(value.shape[dim])[slice(start, end, step)])


def _indexed(graph: Graph, value: Value, indices: Sequence[Any]) -> Value:
    used = [k for k, index in enumerate(indices) if index is not None]
    assert len(used) == 1 and indices[used[0]].dim() == 1, "elements are picked along one axis"
    return _picked(graph, value, used[0], indices[used[0]].remainder(value.shape[used[0]]))


def _flipped(graph: Graph, value: Value, dims: Sequence[int]) -> Value:
    for dim in dims:
        value = _picked(graph, value, dim, torch.arange(value.shape[dim]).flip(0))
    return value


def _cross(graph: Graph, a: Any, b: Any, dim: int = -1) -> Value:
    def turned(value: Any, places: list[int]) -> Any:
        axis, order = dim % len(value.shape), torch.tensor(places)
        if isinstance(value, Value):
            return _picked(graph, value, axis, order)
        return value.index_select(axis, order)

    after, before = [1, 2, 0], [2, 0, 1]
    left = _binary(graph, "mul", turned(a, after), turned(b, before))
    return _binary(graph, "sub", left, _binary(graph, "mul", turned(a, before), turned(b, after)))


def _joined(graph: Graph, parts: Sequence[Any], dim: int = 0) -> Value:
    rank = len(_shape(parts[0]))
    dim %= rank
    parts = [p for p in parts if _shape(p)[dim]]
    if len(parts) == 1 and isinstance(parts[0], Value):
        return parts[0]
    form = graph.beside(parts) if rank == 2 and dim == 1 else None
    if form is not None:
        return form
    solids = [graph.full(p) if isinstance(p, Value) else graph.filled(p) for p in parts]
    shape = [sum(s.shape[dim] for s in solids) if k == dim else n for k, n in enumerate(solids[0].shape)]
    return graph.node("Concat", [s.name for s in solids], shape, shape, axis=dim)


def _stacked(graph: Graph, parts: Sequence[Any], dim: int = 0) -> Value:
    rank = len(_shape(parts[0])) + 1
    apart = [
        _unsqueezed(graph, p, dim % rank) if isinstance(p, Value) else torch.as_tensor(p).unsqueeze(dim) for p in parts
    ]
    return _joined(graph, apart, dim)


def _expanded(graph: Graph, value: Any, shape: Sequence[int]) -> Any:
    if isinstance(value, Tensor):
        return value.expand(*shape)
    solid = graph.solid(value)
    more = len(shape) - len(solid.shape)
    wanted = tuple(solid.shape[k - more] if n == -1 else n for k, n in enumerate(shape))
    for _ in range(more):
        # So that names and shapes agree in rank.
        solid = _unsqueezed(graph, solid, 0)
    return Value(wanted, solid.name, solid.real)


def _broadcast(graph: Graph, tensors: Sequence[Any]) -> list[Any]:
    shape = np.broadcast_shapes(*map(_shape, tensors))
    return [_expanded(graph, t, shape) if isinstance(t, Value) else t.expand(shape) for t in tensors]


def _power(graph: Graph, value: Value, exponent: Any) -> Any:
    if exponent == 0.5:
        return _each(graph, "Sqrt", value)
    if isinstance(exponent, Value) or exponent != int(exponent) or not 0 < exponent < 9:
        return _each(graph, "Pow", value, exponent)
    found, factor = None, value
    for bit in reversed(bin(int(exponent))[2:]):
        if bit == "1":
            found = factor if found is None else _each(graph, "Mul", found, factor)
        factor = _each(graph, "Mul", factor, factor)
    return found


def _clamped(graph: Graph, value: Value, low: Any = None, high: Any = None, **named: Any) -> Value:
    low, high = named.get("min", low), named.get("max", high)
    if low is not None and high is not None and not isinstance(low, Tensor | Value):
        name = graph.solid(value)
        limits = [graph.constant(torch.tensor(float(v), dtype=torch.float64)) for v in (low, high)]
        return graph.node("Clip", [name.name, *limits], name.shape, name.real)
    value = value if low is None else _each(graph, "Max", value, low)
    return value if high is None else _each(graph, "Min", value, high)


def _where(graph: Graph, condition: Any, a: Any, b: Any) -> Value:
    if isinstance(condition, Tensor) and bool(condition.all()) and isinstance(a, Value) and condition.dim() == _rank(a):
        return a
    return _each(graph, "Where", condition, a, b, whole=graph.is_whole(a) and graph.is_whole(b))


def _not_equal(graph: Graph, a: Any, b: Any) -> Value:
    return _each(graph, "Not", _each(graph, "Equal", a, b))


def _finite(graph: Graph, value: Value) -> Value:
    return _each(graph, "Less", _each(graph, "Abs", value), math.inf)


def _numbered(graph: Graph, value: Value, nan: Any = None, posinf: Any = None, neginf: Any = None) -> Value:
    limits = torch.finfo(torch.float64)
    found = _each(graph, "Where", _each(graph, "Equal", value, value), value, nan or 0.0)
    if posinf is None and neginf is None:
        return _clamped(graph, found, limits.min, limits.max)
    for op, edge, to in (("Greater", limits.max, posinf), ("Less", limits.min, neginf)):
        found = _each(graph, "Where", _each(graph, op, found, edge), edge if to is None else to, found)
    return found


def _cast(graph: Graph, value: Value, *_: Any, **__: Any) -> Value:
    """Truth values as numbers."""
    return _where(graph, value, 1.0, 0.0)


def _length(graph: Graph, value: Value, order: Any = 2, dim: Any = None, keepdim: bool = False) -> Value:
    """Euclidean length."""
    assert order == 2
    dim = [dim] if isinstance(dim, int) else dim
    return _each(graph, "Sqrt", _reduced(graph, "ReduceSum", _each(graph, "Mul", value, value), dim, keepdim))


def _every(graph: Graph, value: Value, dim: Any = None, keepdim: bool = False) -> Value:
    return _each(graph, "Greater", _reduced(graph, "ReduceMin", _cast(graph, value), dim, keepdim), 0.5)


def _any(graph: Graph, value: Value, dim: Any = None, keepdim: bool = False) -> Value:
    return _each(graph, "Greater", _reduced(graph, "ReduceMax", _cast(graph, value), dim, keepdim), 0.5)


def _split(graph: Graph, value: Value, sizes: Any, dim: int = 0) -> list[Value]:
    length = value.shape[dim]
    sizes = [min(sizes, length - k) for k in range(0, length, sizes)] if isinstance(sizes, int) else sizes
    ends = np.cumsum(sizes)
    return [_sliced(graph, value, dim, int(end - n), int(end)) for n, end in zip(sizes, ends, strict=True)]


_OTHERS: dict[str, Callable[..., Any]] = {
    "matmul": _matmul, "mm": _matmul, "bmm": _matmul, "linear": _linear,
    "addmm": lambda g, bias, a, b: _binary(g, "add", _matmul(g, a, b), bias),
    "rsub": lambda g, a, b: _binary(g, "sub", b, a),
    "square": lambda g, v: _each(g, "Mul", v, v),
    "rsqrt": lambda g, v: _each(g, "Reciprocal", _each(g, "Sqrt", v)),
    "pow": _power, "clamp": _clamped, "clamp_min": _clamped,
    "clamp_max": lambda g, v, most: _clamped(g, v, None, most), "where": _where, "ne": _not_equal,
    "isfinite": _finite, "nan_to_num": _numbered, "isnan": lambda g, v: _not_equal(g, v, v),
    "all": _every, "any": _any, "to": _cast, "_to_copy": _cast,
    "reshape": _reshaped, "view": _reshaped, "_unsafe_view": _reshaped,
    "flatten": lambda g, v, a=0, b=-1: _reshaped(g, v, [*v.shape[: a % _rank(v)], -1, *v.shape[b % _rank(v) + 1 :]]),
    "unflatten": lambda g, v, d, n: _reshaped(g, v, [*v.shape[: d % _rank(v)], *n, *v.shape[d % _rank(v) + 1 :]]),
    "unsqueeze": _unsqueezed, "squeeze": _squeezed, "permute": _permuted, "transpose": _transposed, "mT": _transposed,
    "t": _transposed, "select": _selected, "slice": _sliced, "index": _indexed, "index_select": _picked,
    "flip": _flipped, "cat": _joined, "stack": _stacked, "expand": _expanded,
    "expand_as": lambda g, a, b: _expanded(g, a, _shape(b)),
    "linalg_cross": _cross, "linalg_vector_norm": _length,
    "broadcast_tensors": _broadcast, "split": _split, "split_with_sizes": _split,
    "unbind": lambda g, v, dim=0: [_selected(g, v, dim, k) for k in range(v.shape[dim])],
}  # fmt: skip
