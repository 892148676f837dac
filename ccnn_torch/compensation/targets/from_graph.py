"""From a traced graph of ATen operations on fixed shapes to a program."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule, Node as GraphNode

from ccnn_torch.compensation.targets.build import Builder
from ccnn_torch.compensation.targets.form import BOOLEAN, Program
from ccnn_torch.errors import MethodFailedError

# More elements, or products, are a loop over arrays; fewer are written out, without those of zeros.
_ELEMENTS, _PRODUCTS = 512, 1024
# Of a thin matrix (masks) so many.
_PRODUCTS_THIN, _THIN = 4096, 0.5

_ELEMENTWISE = {
    "add": "add", "sub": "sub", "mul": "mul", "div": "div", "neg": "neg", "abs": "abs", "exp": "exp", "log": "log",
    "sin": "sin", "cos": "cos", "tan": "tan", "tanh": "tanh", "asin": "asin", "acos": "acos", "atan": "atan",
    "atan2": "atan2", "sqrt": "sqrt", "floor": "floor", "minimum": "min", "maximum": "max", "lt": "lt", "le": "le",
    "eq": "eq", "where": "select", "logical_and": "and", "bitwise_and": "and", "logical_or": "or", "bitwise_or": "or",
    "logical_not": "not", "bitwise_not": "not",
}  # fmt: skip
# What arithmetic of truth values is.
_OF_TRUTHS = {"add": "or", "mul": "and", "max": "or", "min": "and"}
_REDUCTIONS = {"sum": "add", "amax": "max", "amin": "min", "any": "or", "all": "and"}
# What only moves elements: torch does it on their numbers.
_MOVES = frozenset({
    "view", "_unsafe_view", "reshape", "permute", "t", "transpose", "expand", "slice", "select", "unsqueeze", "squeeze",
    "alias", "clone", "flip", "cat", "stack", "index", "index_select", "split", "split_with_sizes", "unbind", "copy",
    "diagonal", "repeat", "roll", "slice_scatter", "select_scatter", "detach", "lift_fresh_copy", "lift_fresh",
})  # fmt: skip
_ASKS = frozenset({"lt", "le", "gt", "ge", "eq", "ne", "isnan", "isfinite", "isinf", "where"})


class Value:
    """A tensor that is not known: its elements' nodes."""

    def __init__(self, ids: Tensor) -> None:
        self.ids = ids


def program_of(traced: GraphModule, name: str, inputs: Sequence[str], outputs: Sequence[str]) -> Program:
    """A program of a traced function whose inputs and outputs are tensors of fixed shapes.

    Args:
        traced: with its operations decomposed.
        outputs: names of its outputs; one without numbers is left out.

    Raises:
        MethodFailedError: there is an operation that no form has.
    """
    graph = traced.graph
    lowering = _Lowering(Builder(any(_name(node) in _ASKS for node in graph.nodes)))
    known: dict[GraphNode, Any] = {}
    given: dict[str, int] = {}
    for node in graph.nodes:
        if node.op == "get_attr":
            known[node] = getattr(traced, node.target).detach()
        elif node.op == "placeholder":
            key = inputs[len(given)]
            shape = node.meta["val"].shape
            given[key] = lowering.builder.input(shape.numel())
            known[node] = Value(given[key] + torch.arange(shape.numel()).reshape(shape))
        elif node.op == "call_function":
            args, kwargs = torch.fx.node.map_arg((node.args, node.kwargs), lambda n: known[n])
            known[node] = lowering.call(node, args, kwargs)
    found = torch.fx.node.map_arg(graph.output_node().args[0], lambda n: known[n])
    found = found if isinstance(found, list | tuple) else [found]
    wanted = {key: lowering.ids(v) for key, v in zip(outputs, found, strict=True) if _shape(v).numel()}
    return lowering.builder.program(name, given, wanted)


def _name(node: GraphNode) -> str:
    """Of the operation, without overload; in-place forms do not occur in a traced graph."""
    return node.target.__name__.partition(".")[0] if node.op == "call_function" else ""  # type: ignore[union-attr]


def _shape(value: Any) -> torch.Size:
    return value.ids.shape if isinstance(value, Value) else value.shape


def _broadcast(*shapes: torch.Size) -> torch.Size:
    return torch.Size(np.broadcast_shapes(*shapes))


class _Lowering:
    """One operation after the other into a builder."""

    def __init__(self, builder: Builder) -> None:
        self.builder = builder

    def ids(self, value: Any) -> Tensor:
        """Nodes of a value or a constant."""
        if isinstance(value, Value):
            return value.ids
        return self.builder.ids(torch.as_tensor(value, dtype=torch.float64))

    def call(self, node: GraphNode, args: Any, kwargs: Any) -> Any:
        name = _name(node)
        if name.startswith(("_assert", "sym_")):
            # Asserted when it was traced, for these shapes.
            return None
        if name == "getitem":
            return args[0][args[1]]
        if not any(isinstance(v, Value) for v in torch.utils._pytree.tree_leaves((args, kwargs))):
            return node.target(*args, **kwargs)  # type: ignore[operator]
        if name in ("full_like", "zeros_like", "ones_like", "empty_like", "new_zeros", "new_ones", "new_full"):
            fill = {"full_like": args[-1], "new_full": args[-1], "ones_like": 1.0, "new_ones": 1.0}.get(name, 0.0)
            return torch.full(node.meta["val"].shape, float(fill), dtype=torch.float64)
        if name in _MOVES:
            return self._moved(node, args, {k: v for k, v in kwargs.items() if k not in ("dtype", "memory_format")})
        if name in _ELEMENTWISE and kwargs.get("rounding_mode") is None:
            alpha = kwargs.get("alpha", 1)
            scaled = args if alpha == 1 else (args[0], self.each("mul", args[1], alpha))
            return self.each(_ELEMENTWISE[name], *scaled)
        if name in _REDUCTIONS:
            dims = args[1] if len(args) > 1 and args[1] is not None else [*range(args[0].ids.dim())]
            keep = args[2] if len(args) > 2 else False
            return self.reduced(_REDUCTIONS[name], args[0], [dims] if isinstance(dims, int) else [*dims], keep)
        composed = _COMPOSED.get(name)
        if composed is None:
            raise MethodFailedError(f"the model needs '{name}', which no target has; leave that part of it out")
        return composed(self, *args, **kwargs)

    def each(self, op: str, *operands: Any) -> Any:
        """An operation on each element of operands that broadcast; numbers and constants among them."""
        known = [torch.as_tensor(v, dtype=torch.float64) if not isinstance(v, Value) else v for v in operands]
        shape = _broadcast(*(v.ids.shape if isinstance(v, Value) else v.shape for v in known))
        # Truth values have no arrays: there are few of them.
        if shape.numel() > _ELEMENTS and op not in BOOLEAN and op != "select":
            parts = [v.ids if isinstance(v, Value) else self._table(v) for v in known]
            return Value(self.builder.loop(op, parts, shape))
        wide = [self.ids(v).expand(shape).flatten().tolist() for v in known]
        if op in _OF_TRUTHS and all(map(self.builder.is_truth, (row[0] for row in wide if row))):
            op = _OF_TRUTHS[op]
        made = [self.builder.apply(op, *row) for row in zip(*wide, strict=True)]
        return Value(torch.tensor(made, dtype=torch.int64).reshape(shape))

    def reduced(self, op: str, value: Value, dims: list[int], keep: bool) -> Value:
        """Sum, maximum or the like over some axes."""
        ids = value.ids
        dims = [d % ids.dim() for d in dims]
        rest = [d for d in range(ids.dim()) if d not in dims]
        rows = ids.permute(*rest, *dims).reshape(*(ids.shape[d] for d in rest), -1)
        if ids.numel() > _ELEMENTS and op in ("add", "max"):
            found = self.builder.loop("", [rows], rows.shape, op)
        else:
            made = [
                reduce(lambda a, b: self.builder.apply(op, a, b), row)
                for row in rows.reshape(-1, rows.shape[-1]).tolist()
            ]
            found = torch.tensor(made, dtype=torch.int64).reshape(rows.shape[:-1])
        if keep:
            found = found.reshape([1 if d in dims else n for d, n in enumerate(ids.shape)])
        return Value(found)

    def product(self, a: Any, b: Any) -> Value:
        """`... x i x k` times `... x k x j`."""
        products, share = _shape(a)[-2] * _shape(b).numel(), 1.0
        for own in (a, b):
            if isinstance(own, Tensor):
                share = int((own != 0).sum()) / own.numel()
                products = int(products * share)
        if products > (_PRODUCTS_THIN if share < _THIN else _PRODUCTS):
            left, right = (v.ids if isinstance(v, Value) else self._table(v) for v in (a, b))
            left, right = left.unsqueeze(-2), right.mT.unsqueeze(-3)
            return Value(self.builder.loop("mul", [left, right], _broadcast(left.shape, right.shape), "add"))
        left, right = self.ids(a).unsqueeze(-2), self.ids(b).mT.unsqueeze(-3)
        shape = _broadcast(left.shape, right.shape)
        apply = self.builder.apply
        made = [
            reduce(lambda s, t: apply("add", s, t), [apply("mul", p, q) for p, q in zip(row, column, strict=True)])
            for row, column in zip(
                left.expand(shape).reshape(-1, shape[-1]).tolist(),
                right.expand(shape).reshape(-1, shape[-1]).tolist(),
                strict=True,
            )
        ]
        return Value(torch.tensor(made, dtype=torch.int64).reshape(shape[:-1]))

    def _table(self, values: Tensor) -> Tensor:
        """Elements of a table; one number alone is none."""
        return self.builder.ids(values) if values.numel() == 1 else self.builder.table(values)

    def _moved(self, node: GraphNode, args: Any, kwargs: Any) -> Any:
        def ids(v: Any) -> Any:
            if isinstance(v, Value):
                return v.ids
            # Beside what is moved there are indices, which stay numbers.
            return self.ids(v) if isinstance(v, Tensor) and v.is_floating_point() else v

        found = node.target(*torch.utils._pytree.tree_map(ids, args), **kwargs)  # type: ignore[operator]
        return [Value(f) for f in found] if isinstance(found, list | tuple) else Value(found)

    # What is made of others.

    def _mv(self, a: Any, b: Any) -> Value:
        column = Value(b.ids.unsqueeze(-1)) if isinstance(b, Value) else b.unsqueeze(-1)
        return Value(self.product(a, column).ids.squeeze(-1))

    def _to_copy(self, value: Value, **_: Any) -> Any:
        # Truth values as numbers.
        if all(self.builder.is_truth(i) for i in value.ids.flatten().tolist()):
            return self.each("select", value, 1.0, 0.0)
        return value

    def _clamp(self, value: Value, least: Any = None, most: Any = None, **named: Any) -> Any:
        least, most = named.get("min", least), named.get("max", most)
        found = value if least is None else self.each("max", value, least)
        return found if most is None else self.each("min", found, most)

    def _pow(self, value: Value, exponent: Any) -> Any:
        if exponent == 0.5:
            return self.each("sqrt", value)
        if isinstance(exponent, Value) or exponent != int(exponent) or not 0 <= exponent < 9:
            return self.each("pow", value, exponent)
        if exponent == 0:
            return torch.ones(value.ids.shape, dtype=torch.float64)
        return reduce(lambda a, b: self.each("mul", a, b), [value] * int(exponent))

    def _mean(self, value: Value, dims: Any = None, keep: bool = False) -> Any:
        dims = [*range(value.ids.dim())] if dims is None else [dims] if isinstance(dims, int) else [*dims]
        count = math.prod(value.ids.shape[d] for d in dims)
        return self.each("mul", self.reduced("add", value, dims, keep), 1.0 / count)

    def _linalg_vector_norm(self, value: Value, order: Any = 2, dims: Any = None, keep: bool = False) -> Any:
        assert order == 2, "lengths are Euclidean"
        dims = [*range(value.ids.dim())] if dims is None else [dims] if isinstance(dims, int) else [*dims]
        return self.each("sqrt", self.reduced("add", self.each("mul", value, value), dims, keep))

    def _linalg_cross(self, a: Any, b: Any, dim: int = -1) -> Any:
        turned = [[self._turned(v, k, dim) for k in (1, 2)] for v in (a, b)]
        (next_a, last_a), (next_b, last_b) = turned
        return self.each("sub", self.each("mul", next_a, last_b), self.each("mul", last_a, next_b))

    def _turned(self, value: Any, places: int, dim: int) -> Any:
        """The coordinates of vectors, so many places on."""
        if isinstance(value, Value):
            return Value(torch.roll(value.ids, -places, dim))
        return torch.roll(value, -places, dim)

    def _nan_to_num(self, value: Value, nan: Any = None, posinf: Any = None, neginf: Any = None) -> Any:
        most = torch.finfo(torch.float64).max
        found = self.each("select", self.each("not", self.each("eq", value, value)), nan or 0.0, value)
        for edge, to, usual in ((math.inf, posinf, most), (-math.inf, neginf, -most)):
            found = self.each("select", self.each("eq", found, edge), usual if to is None else to, found)
        return found

    def _sign(self, value: Value) -> Any:
        below = self.each("select", self.each("lt", value, 0.0), -1.0, 0.0)
        return self.each("select", self.each("lt", 0.0, value), 1.0, below)


_COMPOSED: dict[str, Callable[..., Any]] = {
    "mm": _Lowering.product, "bmm": _Lowering.product, "matmul": _Lowering.product, "mv": _Lowering._mv,
    "addmm": lambda own, bias, a, b: own.each("add", own.product(a, b), bias), "_to_copy": _Lowering._to_copy,
    "relu": lambda own, v: own.each("max", v, 0.0),
    "sigmoid": lambda own, v: own.each("div", 1.0, own.each("add", 1.0, own.each("exp", own.each("neg", v)))),
    "reciprocal": lambda own, v: own.each("div", 1.0, v),
    "rsqrt": lambda own, v: own.each("div", 1.0, own.each("sqrt", v)), "clamp": _Lowering._clamp,
    "clamp_min": _Lowering._clamp, "clamp_max": lambda own, v, most: own._clamp(v, None, most),
    "pow": _Lowering._pow, "mean": _Lowering._mean, "rsub": lambda own, a, b: own.each("sub", b, a),
    "square": lambda own, v: own.each("mul", v, v),
    "hypot": lambda own, a, b: own.each("sqrt", own.each("add", own.each("mul", a, a), own.each("mul", b, b))),
    "linalg_vector_norm": _Lowering._linalg_vector_norm, "linalg_cross": _Lowering._linalg_cross,
    "gt": lambda own, a, b: own.each("lt", b, a), "ge": lambda own, a, b: own.each("le", b, a),
    "ne": lambda own, a, b: own.each("not", own.each("eq", a, b)), "nan_to_num": _Lowering._nan_to_num,
    "isnan": lambda own, v: own.each("not", own.each("eq", v, v)),
    "isinf": lambda own, v: own.each("eq", own.each("abs", v), math.inf),
    "isfinite": lambda own, v: own.each("lt", own.each("abs", v), math.inf), "sign": _Lowering._sign,
}  # fmt: skip
