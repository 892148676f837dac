"""An ONNX graph that is written node by node: constants are folded, equal nodes are one, linear chains are one Gemm.

ONNX Runtime takes 0.3 to 0.5 µs for a node, whatever it does to a row, so that the number of nodes is what a command
costs. A value `rows x w` that is a sum of products of earlier values with constant matrices stays so until somebody
needs its numbers: scalings, layers and differences in between cost nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

# A matrix with more elements is not multiplied with another one when the graph is written.
_LARGEST = 200_000
# What is nearer to 1 is 1 in single precision.
_SINGLE = 2.0**-24


@dataclass(frozen=True)
class Linear:
    """A sum of products of tensors `rows x width` in the graph with matrices `width x w`, and an offset `w`."""

    terms: dict[str, Tensor]
    offset: Tensor

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Linear:
        """With every matrix and the offset changed alike, along their last axis."""
        return Linear({name: change(matrix) for name, matrix in self.terms.items()}, change(self.offset))

    def widened(self, wide: int) -> Linear:
        """One of width 1, so many times."""
        return self.mapped(lambda m: m.expand(*m.shape[:-1], wide))


@dataclass(frozen=True)
class Value:
    """A tensor that depends on the inputs.

    Attributes:
        shape: as in the traced example, whose number of rows stands for the batch.
        name: of the tensor in the graph; "" while it is a linear form.
        real: its shape there: 1 where it broadcasts.
        form: it as a linear form, while nobody needs its numbers.
    """

    shape: tuple[int, ...]
    name: str = ""
    real: tuple[int, ...] = ()
    form: Linear | None = None


class Graph:
    """Nodes and constants so far."""

    def __init__(self, rows: int, opset: int, dtype: str = "float64") -> None:
        """rows: of the traced example, whose multiples are lengths that grow with the batch."""
        self.rows, self.opset = rows, opset
        self._dtype = np.dtype(dtype)
        self.kind = helper.np_dtype_to_tensor_dtype(self._dtype)
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[object, onnx.TensorProto] = {}
        self._known: dict[object, str] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._truths: set[str] = set()
        self._integers: set[str] = set()
        self._nearly_one: dict[str, float] = {}

    def input(self, name: str, width: int, batch: str | int) -> Value:
        """An input `batch x width`."""
        self._inputs.append(helper.make_tensor_value_info(name, self.kind, [batch, width]))
        return Value((self.rows, width), name, (self.rows, width))

    def constant(self, value: Any) -> str:
        """Name of an initializer."""
        array = value.detach().numpy() if isinstance(value, Tensor) else np.asarray(value)
        with np.errstate(over="ignore"):
            # What single precision cannot hold is infinite there.
            array = np.asarray(array.astype(self._dtype) if array.dtype.kind == "f" else array, order="C")
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            self._constants[key] = numpy_helper.from_array(array, f"c{len(self._constants)}")
            if array.size == 1 and array.dtype.kind == "f" and 0 < abs(array.item() - 1) <= _SINGLE:
                self._nearly_one[self._constants[key].name] = array.item()
            if array.dtype.kind in "ib":
                (self._integers if array.dtype.kind == "i" else self._truths).add(self._constants[key].name)
        return str(self._constants[key].name)

    def whole(self, values: int | Sequence[int]) -> str:
        """Name of an initializer of 64-bit integers."""
        return self.constant(np.array(values, np.int64))

    def node(
        self, op: str, inputs: Sequence[str], shape: Sequence[int], real: Sequence[int], **attributes: Any
    ) -> Value:
        """One node; the one before where there is an equal one."""
        if op in ("Mul", "Div") and (near := [name for name in inputs if name in self._nearly_one]):
            # ONNX Runtime (1.32, NoopElimination) takes such a constant for 1 in single precision, and leaves it out.
            doubled = self.constant(2 * self._nearly_one[near[0]])
            half = self.node(op, [doubled if name == near[0] else name for name in inputs], shape, real)
            inputs = [half.name, self.constant(0.5 if op == "Mul" or inputs[0] == near[0] else 2.0)]
            op = "Mul"
        key = (op, *inputs, repr(sorted(attributes.items())))
        if key not in self._known:
            self._known[key] = name = f"v{len(self._known)}"
            self._nodes.append(helper.make_node(op, [*inputs], [name], **attributes))
            first = inputs[-1 if op == "Where" else 0]
            if attributes.get("to") == TensorProto.INT64 or (op in _WHOLE and first in self._integers):
                self._integers.add(name)
            if op in _TRUTHS or (op in _MOVES and inputs[0] in self._truths):
                self._truths.add(name)
        return Value(tuple(shape), self._known[key], tuple(real))

    def solid(self, value: Value) -> Value:
        """The same with its numbers in the graph."""
        form = value.form
        if form is None:
            return value
        if not form.terms:
            return self.filled(form.offset.expand(self.rows, -1))
        width, sums = value.shape[1], {}
        units = {k: _unit(m) for k, m in form.terms.items()}
        if all(units.values()) and len(units) <= 2:
            sums = dict(sorted(units.items(), key=lambda item: -item[1]))
        shape = (self.rows, width)
        if sums and next(iter(sums.values())) > 0:
            first, *rest = sums
            made = Value(shape, first, shape)
            for name in rest:
                made = self.node("Add" if sums[name] > 0 else "Sub", [made.name, name], shape, shape)
            return (
                self.node("Add", [made.name, self.constant(form.offset)], shape, shape) if form.offset.any() else made
            )
        last = ""
        # In the order in which they were made: what does not change from step to step comes first, and is made once.
        for name in sorted(form.terms, key=self._order):
            inputs = [name, self.constant(form.terms[name])]
            inputs += [last] if last else [self.constant(form.offset)] if form.offset.any() else []
            last = self.node("Gemm", inputs, shape, shape).name
        return Value(shape, last, shape)

    def is_whole(self, value: Any) -> bool:
        """Whether it is one of 64-bit integers."""
        if isinstance(value, Value):
            return value.name in self._integers
        return isinstance(value, int) or (isinstance(value, Tensor) and value.dtype == torch.int64)

    def is_truth(self, value: Value) -> bool:
        """Whether it is one of truth values."""
        return value.name in self._truths

    def full(self, value: Value) -> Value:
        """The same, not broadcast."""
        value = self.solid(value)
        if value.real == value.shape:
            return value
        return self.node("Expand", [value.name, self._sizes(value.shape)], value.shape, value.shape)

    def filled(self, constant: Tensor) -> Value:
        """A constant that has as many rows as the batch."""
        shape = tuple(constant.shape)
        return self.node("Expand", [self.constant(self.thin(constant)), self._sizes(shape)], shape, shape)

    def thin(self, constant: Any) -> Tensor:
        """One row of a constant whose rows are those of the batch."""
        tensor = torch.as_tensor(constant)
        for axis, length in enumerate(tensor.shape):
            tensor = tensor.narrow(axis, 0, 1) if length == self.rows else tensor
        return tensor

    def linear(self, value: Value) -> Linear | None:
        """A value `rows x w` as a linear form; None where it is of another shape."""
        if value.form is not None:
            return value.form
        if self.is_whole(value) or self.is_truth(value):
            return None
        if len(value.shape) != 2 or len(value.real) != 2 or value.real[0] != self.rows:
            return None
        width, wide = value.real[1], value.shape[1]
        if width * wide > _LARGEST:
            return None
        matrix = torch.eye(wide, dtype=torch.float64) if width == wide else torch.ones(1, wide, dtype=torch.float64)
        return Linear({value.name: matrix}, torch.zeros(wide, dtype=torch.float64))

    def times(self, value: Value, matrix: Tensor) -> Value | None:
        """A linear form times a matrix `w x v`; None where that is no linear form."""
        form = self.linear(value)
        if form is None or matrix.dim() != 2 or any(len(m) * matrix.shape[1] > _LARGEST for m in form.terms.values()):
            return None
        return self._of_form(form.mapped(lambda m: m @ matrix))

    def scaled(self, value: Value, factor: Any) -> Value | None:
        """A linear form times a number or a row of them."""
        form, row = self.linear(value), self._row(factor, value)
        if form is None or row is None:
            return None
        if len(form.offset) == 1 and row.dim():
            return self.times(value, row.unsqueeze(0))
        return self._of_form(form.mapped(lambda m: m * row))

    def plus(self, a: Value, b: Any) -> Value | None:
        """A linear form and another one, a number or a row of them."""
        form, other = self.linear(a), self.linear(b) if isinstance(b, Value) else None
        if not isinstance(b, Value):
            row = self._row(b, a)
            other = None if row is None else Linear({}, row.reshape(-1))
        if form is None or other is None:
            return None
        wide = max(len(form.offset), len(other.offset))
        if not {len(form.offset), len(other.offset)} <= {1, wide}:
            return None
        form, other = form.widened(wide), other.widened(wide)
        terms = {**form.terms}
        for name, matrix in other.terms.items():
            terms[name] = terms[name] + matrix if name in terms else matrix
        return self._of_form(Linear(terms, form.offset + other.offset))

    def beside(self, parts: Sequence[Any]) -> Value | None:
        """Linear forms and constants side by side; None where one is neither."""
        forms = [self.linear(p) if isinstance(p, Value) else self._fixed(p) for p in parts]
        kept = [form for form in forms if form is not None]
        if len(kept) < len(forms):
            return None
        wide, at = sum(len(form.offset) for form in kept), 0
        terms: dict[str, Tensor] = {}
        for form in kept:
            for name, matrix in form.terms.items():
                whole = terms.setdefault(name, torch.zeros(len(matrix), wide, dtype=torch.float64))
                whole[:, at : at + len(form.offset)] += matrix
            at += len(form.offset)
        return self._of_form(Linear(terms, torch.cat([form.offset for form in kept])))

    def model(self, outputs: Mapping[str, Value | Tensor], batch: str | int, name: str) -> onnx.ModelProto:
        """The graph with its outputs, the named ones, in order."""
        found, renamed = [], {}
        fixed = {i.name for i in self._inputs} | {c.name for c in self._constants.values()}
        for key, value in outputs.items():
            solid = self.full(value) if isinstance(value, Value) else self.filled(value)
            own = solid.name
            if own in fixed or own in renamed:
                own = self.node("Identity", [own], solid.shape, solid.real, doc_string=key).name
            renamed[own] = key
            kind = TensorProto.INT64 if own in self._integers else self.kind
            kind = TensorProto.BOOL if own in self._truths else kind
            found.append(helper.make_tensor_value_info(key, kind, [batch, *solid.shape[1:]]))
        needed, nodes = set(renamed), []
        for node in reversed(self._nodes):
            if node.output[0] in needed:
                needed.update(node.input)
                nodes.append(node)
        for node in nodes:
            node.ClearField("doc_string")
            for names in (node.input, node.output):
                names[:] = [renamed.get(n, n) for n in names]
        constants = [c for c in self._constants.values() if c.name in needed]
        graph = helper.make_graph(nodes[::-1], name, self._inputs, found, constants)
        opsets = [helper.make_opsetid("", self.opset)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=helper.find_min_ir_version_for(opsets))

    def _order(self, name: str) -> int:
        return int(name[1:]) if name[0] == "v" and name[1:].isdigit() else -1

    def _row(self, constant: Any, like: Value) -> Tensor | None:
        """A constant as numbers of one row, `w` or one alone."""
        tensor = self.thin(constant).to(torch.float64)
        if tensor.numel() == 1:
            return tensor.reshape(())
        flat = tensor.reshape(-1)
        return (
            flat if like.shape[-1] in (1, len(flat)) and tensor.dim() <= 2 and tensor.shape[-1] == len(flat) else None
        )

    def _fixed(self, constant: Any) -> Linear | None:
        tensor = torch.as_tensor(constant, dtype=torch.float64)
        return Linear({}, tensor[0]) if tensor.dim() == 2 and tensor.shape[0] == self.rows else None

    def _of_form(self, form: Linear) -> Value:
        """Without tensors that do not count in it, as one of several that were put side by side and taken apart."""
        terms = {name: matrix for name, matrix in form.terms.items() if bool(matrix.any())}
        return Value((self.rows, len(form.offset)), form=Linear(terms, form.offset))

    def _sizes(self, shape: Sequence[int]) -> str:
        """A shape with the batch of the call in it."""
        if all(n % self.rows or n == 0 for n in shape):
            return self.whole(shape)
        first = self._inputs[0].name
        batch = self.node("Shape", [first], (1,), (1,), start=0, end=1).name
        parts = []
        for n in shape:
            times = n // self.rows if n and n % self.rows == 0 else 0
            part = batch
            if times > 1:
                part = self.node("Mul", [batch, self.whole([times])], (1,), (1,)).name
            parts.append(part if times else self.whole([n]))
        return parts[0] if len(parts) == 1 else self.node("Concat", parts, (len(shape),), (len(shape),), axis=0).name


_TRUTHS = frozenset({"Less", "LessOrEqual", "Greater", "GreaterOrEqual", "Equal", "And", "Or", "Not"})
# Whose result is of the type of the first input.
_MOVES = frozenset({
    "Squeeze", "Unsqueeze", "Reshape", "Slice", "Gather", "Expand", "Identity", "Transpose", "Concat", "ReduceMin",
    "ReduceMax",
})  # fmt: skip
_WHOLE = _MOVES | {"Where", "Add"}


def _unit(matrix: Tensor) -> int:
    """1 or -1 where a matrix is that times the unit matrix; else 0."""
    if matrix.shape[0] != matrix.shape[1]:
        return 0
    unit = torch.eye(len(matrix), dtype=matrix.dtype)
    return 1 if torch.equal(matrix, unit) else -1 if torch.equal(matrix, -unit) else 0


def batch_of(sizes: Sequence[int], rows: int) -> list[int]:
    """A shape for Reshape: -1 for the length that grows with the batch."""
    grown = [k for k, n in enumerate(sizes) if n and n % rows == 0]
    assert len(grown) <= 1 or math.prod(sizes) == 0, "two lengths grow with the batch"
    return [-1 if k in grown else n for k, n in enumerate(sizes)]
