"""What the operations of torch are in the few that exports have: one table for ONNX and for programs of numbers."""

from __future__ import annotations

import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Node
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from ccnn_torch.errors import MethodFailedError

# Operation of torch -> ours, on each element of operands that broadcast.
_ELEMENTWISE = {
    name: name
    for name in (
        "add", "sub", "mul", "div", "neg", "abs", "exp", "log", "sin", "cos", "tan", "tanh", "asin", "acos", "atan",
        "atan2", "sqrt", "floor", "lt", "le", "eq",
    )
}  # fmt: skip
_ELEMENTWISE |= {
    "minimum": "min", "maximum": "max", "where": "select", "logical_and": "and", "bitwise_and": "and",
    "logical_or": "or", "bitwise_or": "or", "logical_not": "not", "bitwise_not": "not",
}  # fmt: skip
_REDUCTIONS = {"sum": "add", "amax": "max", "amin": "min", "any": "or", "all": "and"}
_SAME = frozenset({"lift_fresh_copy", "lift_fresh", "detach", "alias", "clone", "copy"})
_FILLS = {"zeros_like": 0.0, "new_zeros": 0.0, "empty_like": 0.0, "ones_like": 1.0, "new_ones": 1.0}
_PRODUCTS = frozenset({"mm", "bmm", "matmul", "mv"})
# Of no consequence where all numbers are of one type.
_IGNORED = frozenset({"dtype", "memory_format", "layout", "device", "pin_memory"})


class Lowering(ABC):
    """One operation after the other, into a form that a subclass keeps; what is constant is worked out by torch.

    Attributes:
        native: operations of torch that the form has beside those of the table: its own names.
    """

    native: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def is_value(self, value: Any) -> bool:
        """Whether it depends on the inputs; it then has a `shape`."""

    @abstractmethod
    def is_truth(self, value: Any) -> bool:
        """Whether a value is one of truth values."""

    @abstractmethod
    def each(self, op: str, *operands: Any) -> Any:
        """An operation on each element of operands that broadcast; numbers and constants are among them."""

    @abstractmethod
    def reduced(self, op: str, value: Any, dims: list[int], keep: bool) -> Any:
        """Sum, maximum or the like of a value over some axes."""

    @abstractmethod
    def product(self, a: Any, b: Any) -> Any:
        """Matrix product `… x i x k` times `… x k x j`, or times `k`."""

    @abstractmethod
    def picked(self, value: Any, dim: int, places: Tensor) -> Any:
        """Elements of a value or a constant along one axis."""

    @abstractmethod
    def moved(self, node: Node, args: Any, kwargs: Any) -> Any:
        """What an operation gives that only moves elements; None where it is none of these."""

    def run(self, traced: GraphModule, inputs: Sequence[Any]) -> list[Any]:
        """Outputs of a traced function, values or constants, for inputs that are either.

        Raises:
            MethodFailedError: there is an operation that no export has.
        """
        given, known = iter(inputs), dict[Node, Any]()
        for node in traced.graph.nodes:
            if node.op == "placeholder":
                known[node] = next(given)
            elif node.op == "get_attr":
                known[node] = getattr(traced, node.target).detach()
            elif node.op == "call_function":
                known[node] = self._called(node, *torch.fx.node.map_arg((node.args, node.kwargs), lambda n: known[n]))
        found = torch.fx.node.map_arg(traced.graph.output_node().args[0], lambda n: known[n])
        return list(found) if isinstance(found, list | tuple) else [found]

    def _called(self, node: Node, args: Any, kwargs: Any) -> Any:
        name = operation_of(node)
        if name.startswith(("_assert", "sym_")):
            # Asserted when it was traced, for these shapes.
            return None
        if name == "getitem":
            return args[0][args[1]]
        if not any(map(self.is_value, tree_leaves((args, kwargs)))):
            with torch.no_grad():
                return node.target(*args, **kwargs)  # type: ignore[operator]
        if node.meta.get("val") is not None and not node.meta["val"].numel():
            return node.meta["val"]
        kwargs = {key: value for key, value in kwargs.items() if key not in _IGNORED}
        if name in _SAME:
            return args[-1] if name == "copy" else args[0]
        if name in _FILLS or name in ("full_like", "new_full"):
            return torch.full(node.meta["val"].shape, float(_FILLS.get(name, args[-1])), dtype=torch.float64)
        if name in self.native and not kwargs and len(args) == 1:
            return self.each(self.native[name], *args)
        if name in _ELEMENTWISE and kwargs.get("rounding_mode") is None:
            alpha = kwargs.get("alpha", 1)
            scaled = args if alpha == 1 else (args[0], self.each("mul", args[1], alpha))
            return self.each(_ELEMENTWISE[name], *scaled)
        if name in _REDUCTIONS:
            return self._over(_REDUCTIONS[name], *args, **kwargs)
        if name in _PRODUCTS:
            return self.product(*args)
        moved = self.moved(node, args, kwargs)
        if moved is not None:
            return moved
        composed = _COMPOSED.get(name)
        if composed is None:
            raise MethodFailedError(f"the model needs '{name}', which no target has; leave that part of it out")
        return composed(self, *args, **kwargs)

    def _over(self, op: str, value: Any, dim: Any = None, keepdim: bool = False) -> Any:
        return self.reduced(op, value, _dims(value, dim), keepdim)

    # What is made of others.

    def clamped(self, value: Any, low: Any = None, high: Any = None, **named: Any) -> Any:
        """Within limits."""
        low, high = named.get("min", low), named.get("max", high)
        found = value if low is None else self.each("max", value, low)
        return found if high is None else self.each("min", found, high)

    def _power(self, value: Any, exponent: Any) -> Any:
        if exponent == 0.5:
            return self.each("sqrt", value)
        if self.is_value(exponent) or exponent != int(exponent) or not 0 < exponent < 9:
            return self.each("pow", value, exponent)
        return reduce(lambda a, b: self.each("mul", a, b), [value] * int(exponent))

    def _mean(self, value: Any, dim: Any = None, keepdim: bool = False) -> Any:
        count = math.prod(value.shape[d] for d in _dims(value, dim))
        return self.each("mul", self._over("add", value, dim, keepdim), 1.0 / count)

    def _length(self, value: Any, order: Any = 2, dim: Any = None, keepdim: bool = False) -> Any:
        assert order == 2, "lengths are Euclidean"
        return self.each("sqrt", self._over("add", self.each("mul", value, value), dim, keepdim))

    def _cross(self, a: Any, b: Any, dim: int = -1) -> Any:
        places = torch.tensor([1, 2, 0]), torch.tensor([2, 0, 1])
        (next_a, last_a), (next_b, last_b) = ([self.picked(v, dim % len(v.shape), p) for p in places] for v in (a, b))
        return self.each("sub", self.each("mul", next_a, last_b), self.each("mul", last_a, next_b))

    def _number(self, value: Any, nan: Any = None, posinf: Any = None, neginf: Any = None) -> Any:
        most = torch.finfo(torch.float64).max
        found = self.each("select", self.each("eq", value, value), value, nan or 0.0)
        if posinf is None and neginf is None:
            return self.clamped(found, -most, most)
        above, below = most if posinf is None else posinf, -most if neginf is None else neginf
        found = self.each("select", self.each("lt", most, found), above, found)
        return self.each("select", self.each("lt", found, -most), below, found)

    def _sign(self, value: Any) -> Any:
        below = self.each("select", self.each("lt", value, 0.0), -1.0, 0.0)
        return self.each("select", self.each("lt", 0.0, value), 1.0, below)

    def _cast(self, value: Any, *_: Any, **__: Any) -> Any:
        """Truth values as numbers."""
        return self.each("select", value, 1.0, 0.0) if self.is_truth(value) else value


def operation_of(node: Node) -> str:
    """Of a node, without overload; "" where it is none."""
    return node.target.__name__.partition(".")[0] if node.op == "call_function" else ""  # type: ignore[union-attr]


def _dims(value: Any, dim: Any) -> list[int]:
    rank = len(value.shape)
    return [d % rank for d in (range(rank) if dim is None else [dim] if isinstance(dim, int) else dim)]


_COMPOSED: dict[str, Callable[..., Any]] = {
    "addmm": lambda own, bias, a, b: own.each("add", own.product(a, b), bias),
    "relu": lambda own, v: own.each("max", v, 0.0),
    "sigmoid": lambda own, v: own.each("div", 1.0, own.each("add", 1.0, own.each("exp", own.each("neg", v)))),
    "reciprocal": lambda own, v: own.each("div", 1.0, v),
    "rsqrt": lambda own, v: own.each("div", 1.0, own.each("sqrt", v)),
    "rsub": lambda own, a, b: own.each("sub", b, a),
    "hypot": lambda own, a, b: own.each("sqrt", own.each("add", own.each("mul", a, a), own.each("mul", b, b))),
    "clamp": lambda own, *args, **named: own.clamped(*args, **named),
    "clamp_min": lambda own, v, least: own.clamped(v, least),
    "clamp_max": lambda own, v, most: own.clamped(v, None, most),
    "pow": Lowering._power, "mean": Lowering._mean, "sign": Lowering._sign, "nan_to_num": Lowering._number,
    "linalg_vector_norm": Lowering._length, "linalg_cross": Lowering._cross,
    "gt": lambda own, a, b: own.each("lt", b, a), "ge": lambda own, a, b: own.each("le", b, a),
    "ne": lambda own, a, b: own.each("not", own.each("eq", a, b)),
    "isnan": lambda own, v: own.each("not", own.each("eq", v, v)),
    "isinf": lambda own, v: own.each("eq", own.each("abs", v), math.inf),
    "isfinite": lambda own, v: own.each("lt", own.each("abs", v), math.inf),
    "_to_copy": Lowering._cast,
}  # fmt: skip


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
