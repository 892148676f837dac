"""Putting a program together: numbers that are known are folded, equal ones are one, and dead ones are left out.

A tensor is an int64 tensor of node numbers, so that whatever only moves elements (view, slice, cat) is done by torch on
these numbers and costs nothing in a program.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation.targets.form import (
    BOOLEAN,
    OPERATIONS,
    Array,
    Expression,
    Leaf,
    Let,
    Loop,
    Node,
    Program,
    leaves,
    live_steps,
    merge_axes,
    put_loops_together,
)

# Operands in whatever order are the same.
_COMMUTATIVE = frozenset({"add", "mul", "min", "max", "eq", "and", "or"})
# Finite where what they take is: an argument is in a cage around the domain, where nothing overflows.
_FINITE = frozenset({"add", "sub", "mul", "neg", "abs", "min", "max", "exp", "sin", "cos", "tanh", "atan", "floor"})
# Rounding of a multiple.
_SAME = 1e-13


class Builder:
    """Nodes, buffers and steps so far."""

    def __init__(self, careful: bool) -> None:
        """careful: what may be infinite or no number is not taken for finite, since the model asks for it."""
        self._careful = careful
        self._nodes: dict[int, Node] = {}
        self._known: dict[object, int] = {}
        self._finite: set[int] = set()
        self._steps: list[Let | Loop] = []
        self._sizes: dict[int, int] = {}
        self._starts: list[int] = []
        # Of what is multiplied the factors that a sine or cosine was taken of, without multiples of others.
        self._angles: dict[int, list[float]] = {}
        self._tables: dict[int, Array] = {}
        # Numbers that may be none: (whether there is one, the number). Some targets have no constant that is no number.
        self._maybe: dict[int, tuple[int, int]] = {}
        self._truths: dict[int, frozenset[int]] = {}
        self._next = 0

    def constant(self, value: float) -> int:
        """Its node."""
        key = ("const", float(value).hex())
        if key not in self._known:
            self._known[key] = self._add(Node("const", value=float(value)), math.isfinite(value))
        return self._known[key]

    def ids(self, values: Tensor) -> Tensor:
        """Nodes of constants, of the same shape."""
        flat = [self.constant(v) for v in values.to(torch.float64).flatten().tolist()]
        return torch.tensor(flat, dtype=torch.int64).reshape(values.shape)

    def buffer(self, size: int) -> int:
        """A new buffer: its number is that of its first element, the others follow."""
        start = self._next
        self._next += size
        if size:
            self._starts.append(start)
        self._sizes[start] = size
        return start

    def table(self, values: Tensor) -> Tensor:
        """Elements of a constant table, of the same shape."""
        flat = values.to(torch.float64).contiguous().numpy().ravel()
        key = ("table", flat.tobytes())
        if key not in self._known:
            self._known[key] = start = self.buffer(len(flat))
            self._tables[start] = flat.copy()
        return self._known[key] + torch.arange(values.numel()).reshape(values.shape)

    def input(self, size: int) -> int:
        """A buffer that is given; its elements are finite, or the first steps make them so."""
        start = self.buffer(size)
        for k in range(size):
            self._load(start + k)
            self._finite.add(start + k)
        return start

    def is_truth(self, i: int) -> bool:
        """Whether a node is a truth value."""
        return self._nodes[i].op in BOOLEAN if i in self._nodes else False

    def apply(self, op: str, *args: int) -> int:
        """The node of an operation, simplified."""
        if op == "select" and self._is_none(args[2]) and args[1] not in self._maybe:
            return self._perhaps(args[0], args[1])
        if any(i in self._maybe for i in args):
            return self._of_maybe(op, args)
        found = self._simplified(op, args)
        if found is not None:
            return found
        if op in _COMMUTATIVE:
            args = tuple(sorted(args))
        key = (op, args)
        if key not in self._known:
            finite = op in _FINITE and all(map(self._is_finite, args))
            finite |= op == "select" and all(map(self._is_finite, args[1:]))
            # Of 1 + exp(x), in a sigmoid.
            finite |= op == "div" and self._value(args[0]) == 1.0 and self._above_one(args[1])
            self._known[key] = node = self._add(Node(op, args), finite)
            self._steps.append(Let(node))
        return self._known[key]

    def loop(self, op: str, operands: Sequence[Tensor], shape: Sequence[int], reduce: str = "") -> Tensor:
        """An array: an operation on operands that broadcast to `shape`, its last axis reduced where `reduce` says how.

        Args:
            op: operation, or "" for the one operand itself.
            operands: nodes.
        """
        leaves = [self._leaf(self._certain(ids), shape) for ids in operands]
        expression: Expression = (op, *leaves) if op else leaves[0]
        key = (expression, tuple(shape), reduce)
        outer = list(shape[:-1] if reduce else shape)
        size = math.prod(outer)
        if key not in self._known:
            self._known[key] = self.buffer(size)
            self._steps.append(merge_axes(Loop(self._known[key], tuple(shape), expression, reduce)))
        return self._known[key] + torch.arange(size).reshape(outer)

    def program(self, name: str, inputs: dict[str, int], outputs: dict[str, Tensor]) -> Program:
        """What was built, without what the outputs do not need."""
        wanted = {key: [int(i) for i in self._certain(ids).flatten()] for key, ids in outputs.items()}
        every = {i for ids in wanted.values() for i in ids}
        for i in every:
            self._load(i)
        steps = put_loops_together(live_steps(self._steps, self._nodes, every), self._nodes, every)
        read = {b.buffer for s in steps if isinstance(s, Loop) for b in leaves(s.expression) if isinstance(b, Leaf)}
        tables = {start: values for start, values in self._tables.items() if start in read}
        return Program(name, inputs, wanted, self._nodes, self._sizes, tables, steps)

    def _add(self, node: Node, finite: bool) -> int:
        self._nodes[self._next] = node
        if finite:
            self._finite.add(self._next)
        self._next += 1
        return self._next - 1

    def _is_none(self, i: int) -> bool:
        value = self._value(i)
        return value is not None and math.isnan(value)

    def _perhaps(self, there: int, value: int) -> int:
        """A number where there is one."""
        if self._value(there) == 1.0:
            return value
        key = ("maybe", there, value)
        if key not in self._known:
            self._known[key] = self._next
            self._maybe[self._next] = (there, value)
            self._next += 1
        return self._known[key]

    def _of_maybe(self, op: str, args: tuple[int, ...]) -> int:
        """What is made of numbers that may be none is none where one is; comparisons with it are false."""
        parts = [self._maybe.get(i, (self.constant(1.0), i)) for i in args]
        value = self.apply(op, *(v for _, v in parts))
        if op == "select":
            (_, which), (first, _), (second, _) = parts
            if self._is_none(args[2]):
                return self._perhaps(self.apply("and", which, first), parts[1][1])
            return self._perhaps(self._chosen(which, first, second), value)
        there = reduce(lambda a, b: self.apply("and", a, b), (t for t, _ in parts))
        if op in BOOLEAN:
            # The same number twice: whether there is one.
            return self.apply("and", there, value)
        return self._perhaps(there, value)

    def _chosen(self, which: int, first: int, second: int) -> int:
        """One of two truth values."""
        if first == second:
            return first
        other = self.apply("not", which)
        for one, two, here in ((first, second, which), (second, first, other)):
            if self._value(two) == 1.0 and self._parts(one) <= self._parts(here):
                return two
        left, right = self.apply("and", which, first), self.apply("and", other, second)
        return self.apply("or", left, right)

    def _parts(self, i: int) -> frozenset[int]:
        """What must all be true for a truth value to be."""
        if i not in self._truths:
            node = self._nodes[i]
            own = frozenset([i] if self._value(i) != 1.0 else [])
            self._truths[i] = frozenset().union(*map(self._parts, node.args)) if node.op == "and" else own
        return self._truths[i]

    def _certain(self, ids: Tensor) -> Tensor:
        """With numbers that may be none as such."""
        if not self._maybe:
            return ids
        flat = [self._solid(i) for i in ids.flatten().tolist()]
        return torch.tensor(flat, dtype=torch.int64).reshape(ids.shape)

    def _solid(self, i: int) -> int:
        if i not in self._maybe:
            return i
        there, value = self._maybe[i]
        key = ("select", (there, value, self.constant(math.nan)))
        if key not in self._known:
            self._known[key] = node = self._add(Node(*key), False)
            self._steps.append(Let(node))
        return self._known[key]

    def _owner(self, i: int) -> int | None:
        """The buffer of an element; None for another node."""
        at = bisect.bisect_right(self._starts, i) - 1
        start = self._starts[at] if at >= 0 else 0
        return start if at >= 0 and i < start + self._sizes[start] else None

    def _load(self, i: int) -> None:
        """Note what an element of a buffer is, for those who read it by its number."""
        owner = self._owner(i)
        if owner is not None and i not in self._nodes:
            self._nodes[i] = Node("load", (owner, i - owner))

    def _is_finite(self, i: int) -> bool:
        # Inputs are caged; a large array was not followed.
        return not self._careful or i in self._finite

    def _value(self, i: int) -> float | None:
        node = self._nodes.get(i)
        return node.value if node is not None and node.op == "const" else None

    def _above_one(self, i: int) -> bool:
        node = self._nodes.get(i)
        if node is None or node.op != "add":
            return False
        parts = [self._nodes[k].op for k in node.args if k in self._nodes]
        return "exp" in parts and 1.0 in [self._value(k) for k in node.args]

    def _simplified(self, op: str, args: tuple[int, ...]) -> int | None:
        for i in args:
            self._load(i)
        values = [self._value(i) for i in args]
        if all(v is not None for v in values):
            with np.errstate(all="ignore"):
                return self.constant(float(OPERATIONS[op](*(np.float64(v) for v in values if v is not None))))
        first, second = args[0], args[-1]
        a, b = values[0], values[-1]
        if op in ("add", "sub"):
            return self._sum(op, first, second)
        if op in ("not", "neg") and self._nodes[first].op == op:
            return self._nodes[first].args[0]
        if op == "mul":
            return self._product(first, second)
        if op in ("and", "or") and (a is not None or b is not None):
            value, other = (a, second) if a is not None else (b, first)
            return other if bool(value) == (op == "and") else self.constant(float(op == "or"))
        if op == "and":
            for x, y in ((first, second), (second, first)):
                if self._parts(y) <= self._parts(x):
                    return x
        if op == "div" and a == 0.0 and self._is_finite(second):
            return first
        if op == "div" and b is not None and b != 0.0 and 1e-300 < abs(1 / b) < 1e300:
            return self.apply("mul", first, self.constant(1 / b))
        if op in ("sin", "cos"):
            return self._of_multiple(op, first)
        if op in ("min", "max") and first == second:
            return first
        if op == "select" and a is not None:
            return args[1] if a else args[2]
        if op == "select" and args[1] == args[2]:
            return args[1]
        return None

    def _sum(self, op: str, first: int, second: int) -> int | None:
        """Or difference, of a constant 0 or a negated node and another."""
        if self._value(second) == 0.0:
            return first
        if self._value(first) == 0.0:
            return second if op == "add" else self.apply("neg", second)
        if self._nodes[second].op == "neg":
            return self.apply("sub" if op == "add" else "add", first, self._nodes[second].args[0])
        if op == "add" and self._nodes[first].op == "neg":
            return self.apply("sub", second, self._nodes[first].args[0])
        return None

    def _product(self, first: int, second: int) -> int | None:
        """Of a constant and a node, or of negated ones."""
        for x, y in ((first, second), (second, first)):
            factor, node = self._value(x), self._nodes[y]
            if factor == 0.0 and self._is_finite(y):
                return x
            if factor == 1.0:
                return y
            if factor == -1.0:
                return self.apply("neg", y)
            if factor is not None and node.op == "neg":
                return self.apply("mul", self.constant(-factor), node.args[0])
            if factor is not None and node.op == "mul":
                for p, q in (node.args, node.args[::-1]):
                    inner = self._value(p)
                    if inner is not None:
                        return self.apply("mul", self.constant(factor * inner), q)
        return None

    def _of_multiple(self, op: str, angle: int) -> int | None:
        """Sine or cosine of a whole multiple of an angle, by the angles' sums: harmonics of a gear are dozens."""
        node, factor, part = self._nodes[angle], 1.0, angle
        if node.op == "mul":
            for x, y in (node.args, node.args[::-1]):
                value = self._value(x)
                if value:
                    factor, part = value, y
        firsts = self._angles.setdefault(part, [])
        for first in firsts:
            times = round(factor / first)
            if times >= 1 and abs(factor / first - times) <= _SAME * times:
                return self._shifted(op, angle) if factor == first else self._harmonic(op, part, first, times)
        firsts.append(factor)
        return self._shifted(op, angle)

    def _shifted(self, op: str, angle: int) -> int | None:
        """sin (x - c) where sine and cosine of x are known."""
        node = self._nodes[angle]
        shift = self._value(node.args[1]) if node.op == "sub" else None
        if shift is None or not self._known.keys() >= {("sin", node.args[:1]), ("cos", node.args[:1])}:
            return None
        own, other = (self._known[f, node.args[:1]] for f in ((op, "cos") if op == "sin" else (op, "sin")))
        right = self.apply("mul", self.constant(math.sin(shift)), other)
        left = self.apply("mul", self.constant(math.cos(shift)), own)
        return self.apply("sub" if op == "sin" else "add", left, right)

    def _harmonic(self, op: str, part: int, first: float, times: int) -> int:
        """sin (a + b) = 2 cos a sin b - sin (b - a), the same of cosines, with b = a or a + 1."""
        key = (op, part, first, times)
        if key not in self._known and times == 0:
            self._known[key] = self.constant(float(op == "cos"))
        elif key not in self._known and times == 1:
            self._known[key] = self.apply(op, self.apply("mul", self.constant(first), part))
        elif key not in self._known:
            a, b = times // 2, times - times // 2
            twice = self.apply("mul", self.constant(2.0), self._harmonic("cos", part, first, a))
            product = self.apply("mul", twice, self._harmonic(op, part, first, b))
            self._known[key] = self.apply("sub", product, self._harmonic(op, part, first, b - a))
        return self._known[key]

    def _leaf(self, ids: Tensor, shape: Sequence[int]) -> Expression:
        """How a loop reads these nodes: one of them all the time, or elements of a buffer that are evenly apart."""
        wide = ids.expand(*shape)
        first = int(wide.flatten()[0])
        if bool((wide == first).all()):
            self._load(first)
            return first
        owner = self._owner(first)
        steps = [int(wide.select(d, 1).flatten()[0]) - first if n > 1 else 0 for d, n in enumerate(shape)]
        even = torch.full((), first)
        for step, n in zip(steps, shape, strict=True):
            even = even.unsqueeze(-1) + step * torch.arange(n)
        ends = {self._owner(int(wide.min())), self._owner(int(wide.max()))}
        if owner is None or ends != {owner} or not bool((even == wide).all()):
            return self._leaf(self._packed(ids) + torch.arange(ids.numel()).reshape(ids.shape), shape)
        return Leaf(owner, first - owner, tuple(steps))

    def _packed(self, ids: Tensor) -> int:
        """A buffer that nodes were copied into."""
        flat = ids.flatten().tolist()
        key = ("packed", tuple(flat))
        if key not in self._known:
            self._known[key] = start = self.buffer(len(flat))
            for k, i in enumerate(flat):
                self._load(i)
                self._steps.append(Let(i, (start, k)))
        return self._known[key]
