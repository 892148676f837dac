"""The form of a compensator: its functions as programs, traced for one row, and the routines that call them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.fit import SINGLE_TOLERANCE, single_steps
from ccnn_torch.compensation.routines import ControllerFunctions, Routine, routines_of
from ccnn_torch.compensation.targets.build import Builder
from ccnn_torch.compensation.targets.form import BOOLEAN, Form, Program
from ccnn_torch.compensation.targets.lowering import Lowering, operation_of, recorded

# More elements, or products, are a loop over arrays; fewer are written out, without those of zeros.
_ELEMENTS, _PRODUCTS = 512, 1024
# Of a thin matrix (masks) so many.
_PRODUCTS_THIN, _THIN = 4096, 0.5
# What arithmetic of truth values is.
_OF_TRUTHS = {"add": "or", "mul": "and", "max": "or", "min": "and"}
# What only moves elements: torch does it on their numbers.
_MOVES = frozenset({
    "permute", "t", "transpose", "expand", "slice", "select", "unsqueeze", "squeeze",
    "flip", "cat", "stack", "index", "index_select", "split", "split_with_sizes", "unbind", "diagonal", "repeat",
    "roll", "slice_scatter", "select_scatter",
})  # fmt: skip
_ASKS = frozenset({"lt", "le", "gt", "ge", "eq", "ne", "isnan", "isfinite", "isinf", "where"})
# From here a number counts as infinite where single precision has no 1e300.
_HUGE_SINGLE = 3e38


class Value:
    """A tensor that is not known: its elements' nodes."""

    def __init__(self, ids: Tensor) -> None:
        self.ids = ids

    @property
    def shape(self) -> torch.Size:
        """Of the tensor."""
        return self.ids.shape


def program_of(traced: GraphModule, name: str, inputs: Sequence[str], outputs: Sequence[str]) -> Program:
    """A program of a traced function whose inputs and outputs are tensors of fixed shapes.

    Args:
        traced: with its operations decomposed.
        outputs: names of its outputs; one without numbers is left out.

    Raises:
        MethodFailedError: there is an operation that no form has.
    """
    nodes = traced.graph.nodes
    builder = Builder(any(operation_of(node) in _ASKS for node in nodes))
    shapes = [node.meta["val"].shape for node in nodes if node.op == "placeholder"]
    starts = [builder.input(shape.numel()) for shape in shapes]
    values = [Value(i + torch.arange(shape.numel()).reshape(shape)) for i, shape in zip(starts, shapes, strict=True)]
    lowering = _ByElements(builder)
    found = zip(outputs, lowering.run(traced, values), strict=True)
    wanted = {key: lowering.ids(value) for key, value in found if value.shape.numel()}
    return builder.program(name, dict(zip(inputs, starts, strict=True)), wanted)


class _ByElements(Lowering):
    def __init__(self, builder: Builder) -> None:
        self.builder = builder

    def ids(self, value: Any) -> Tensor:
        """Nodes of a value or a constant."""
        if isinstance(value, Value):
            return value.ids
        return self.builder.ids(torch.as_tensor(value, dtype=torch.float64))

    def is_value(self, value: Any) -> bool:
        return isinstance(value, Value)

    def is_truth(self, value: Any) -> bool:
        return all(map(self.builder.is_truth, value.ids.flatten().tolist()))

    def each(self, op: str, *operands: Any) -> Any:
        known = [v if isinstance(v, Value) else torch.as_tensor(v, dtype=torch.float64) for v in operands]
        shape = torch.Size(np.broadcast_shapes(*(v.shape for v in known)))
        # Truth values have no arrays: there are few of them.
        if shape.numel() > _ELEMENTS and op not in BOOLEAN and op != "select":
            return Value(self.builder.loop(op, [self._read(v) for v in known], shape))
        wide = [self.ids(v).expand(shape).flatten().tolist() for v in known]
        if op in _OF_TRUTHS and all(map(self.builder.is_truth, (row[0] for row in wide if row))):
            op = _OF_TRUTHS[op]
        made = [self.builder.apply(op, *row) for row in zip(*wide, strict=True)]
        return Value(torch.tensor(made, dtype=torch.int64).reshape(shape))

    def reduced(self, op: str, value: Value, dims: list[int], keep: bool) -> Value:
        ids = value.ids
        rest = [d for d in range(ids.dim()) if d not in dims]
        rows = ids.permute(*rest, *dims).reshape(*(ids.shape[d] for d in rest), -1)
        looped = ids.numel() > _ELEMENTS and op in ("add", "max")
        found = self.builder.loop("", [rows], rows.shape, op) if looped else self._folded(op, rows)
        return Value(found.reshape([1 if d in dims else n for d, n in enumerate(ids.shape)]) if keep else found)

    def product(self, a: Any, b: Any) -> Value:
        if len(b.shape) == 1:
            column = Value(b.ids.unsqueeze(-1)) if isinstance(b, Value) else b.unsqueeze(-1)
            return Value(self.product(a, column).ids.squeeze(-1))
        products, share = a.shape[-2] * b.shape.numel(), 1.0
        for own in (a, b):
            if isinstance(own, Tensor):
                share = int((own != 0).sum()) / own.numel()
                products = int(products * share)
        looped = products > (_PRODUCTS_THIN if share < _THIN else _PRODUCTS)
        left, right = (self._read(v) if looped else self.ids(v) for v in (a, b))
        left, right = left.unsqueeze(-2), right.mT.unsqueeze(-3)
        shape = torch.Size(np.broadcast_shapes(left.shape, right.shape))
        if looped:
            return Value(self.builder.loop("mul", [left, right], shape, "add"))
        pairs = zip(left.expand(shape).flatten().tolist(), right.expand(shape).flatten().tolist(), strict=True)
        made = [self.builder.apply("mul", *pair) for pair in pairs]
        return Value(self._folded("add", torch.tensor(made, dtype=torch.int64).reshape(shape)))

    def picked(self, value: Any, dim: int, places: Tensor) -> Any:
        return (
            Value(value.ids.index_select(dim, places)) if isinstance(value, Value) else value.index_select(dim, places)
        )

    def moved(self, node: Node, args: Any, kwargs: Any) -> Any:
        name = operation_of(node)
        if name in ("view", "_unsafe_view"):
            return Value(args[0].ids.reshape(args[1]))
        if name not in _MOVES:
            return None

        def ids(v: Any) -> Any:
            if isinstance(v, Value):
                return v.ids
            # Beside what is moved there are indices, which stay numbers.
            return self.ids(v) if isinstance(v, Tensor) and v.is_floating_point() else v

        found = node.target(*torch.utils._pytree.tree_map(ids, args), **kwargs)  # type: ignore[operator]
        return [Value(f) for f in found] if isinstance(found, list | tuple) else Value(found)

    def _folded(self, op: str, rows: Tensor) -> Tensor:
        """Nodes `… x k` put together by an operation, `…`."""
        flat = rows.reshape(-1, rows.shape[-1]).tolist()
        made = [reduce(lambda a, b: self.builder.apply(op, a, b), row) for row in flat]
        return torch.tensor(made, dtype=torch.int64).reshape(rows.shape[:-1])

    def _read(self, value: Any) -> Tensor:
        """What a loop reads: nodes, or elements of a table; one number alone is none."""
        alone = isinstance(value, Value) or value.numel() == 1
        return self.ids(value) if alone else self.builder.table(value)


# As in the check of every other model file: what is left of command + deviation = joints, as a share of the limit.
_SLACK = {"float64": 1e-6, "float32": SINGLE_TOLERANCE}


def form_of(compensator: Compensator, dtype: str = "float64", sd: bool = False) -> Form:
    """The form of a fitted compensator.

    Args:
        dtype: `float64` or `float32`, in which the targets compute.
        sd: with the routine for the standard deviation.

    Raises:
        MethodFailedError: the model has an operation that no form has.
    """
    own = copy.deepcopy(compensator)
    if dtype == "float32":
        own.domain.huge.clamp_(max=_HUGE_SINGLE)
        if not own.secant:
            own.iterations = single_steps(own)
    routines = routines_of(own)
    if sd:
        about = "Standard deviation of a newly measured deviation at a command, model and noise."
        routines.append(Routine("deviation_sd", about, "command", ("sd",), ("clean", "spread")))
    functions, examples = ControllerFunctions(own, _SLACK[dtype], dtype), dict[str, Tensor]()
    names = dict.fromkeys(name for routine in routines for name, _ in routine.calls)
    with torch.no_grad():
        for routine in routines:
            examples = functions.run(routine.statements, functions.start(own.domain.centre.unsqueeze(0))) | examples
    read = {key for routine in routines for key in routine.read}.union(*map(functions.inputs_of, names))
    way = "the fixed point" if own.machine is None else "Gauss and Newton's method"
    return Form(
        [c.header for c in own.joints],
        [c.header for c in own.covariates],
        own.iterations,
        "Broyden's method" if own.secant else way,
        own.most.numpy(),
        dtype,
        {name: _program(functions, name, examples, read) for name in names},
        {routine.name: routine for routine in routines},
    )


def _program(functions: ControllerFunctions, name: str, values: dict[str, Tensor], read: set[str]) -> Program:
    """One of the functions; variables without numbers are left out, as covariates where there are none.

    Args:
        values: an example of every variable.
        read: variables that something reads.
    """
    every = functions.inputs_of(name)
    # A tensor of its own for each: the tracer takes equal tensors for one input.
    examples = {i: values[i].clone() for i in every if values[i].numel()}
    outputs = [key for key in functions.call(name, values) if key in read]

    def called(*given: Tensor) -> Sequence[Tensor]:
        found = functions.call(name, values | dict(zip(examples, given, strict=True)))
        return [found[key] for key in outputs]

    return traced_program(called, [*examples.values()], name, [*examples], outputs)


def traced_program(
    function: Callable[..., Tensor | Sequence[Tensor]],
    example: Sequence[Tensor],
    name: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Program:
    """A function as a program, traced for one row.

    Raises:
        MethodFailedError: it has an operation that no form has.
    """
    return program_of(recorded(function, example), name, inputs, outputs)
