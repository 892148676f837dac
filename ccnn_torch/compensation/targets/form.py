"""The form of a model that every target prints: typed operations on numbers, loops over arrays, constant tables.

A `Form` has the functions of one model (inputs made finite, a step towards the command, its end) as programs, and the
routines that call them. A program is a list of steps in an order in which they can be computed. Each value is assigned
once, all sizes are constants, and there is no branch: a program always does the same operations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.compensation.routines import Copy, Routine

Array = NDArray[Any]

# What an operation does, on numpy arrays. `select` takes condition, then, else.
OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "abs": np.abs,
    "min": np.minimum,
    "max": np.maximum,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "tanh": np.tanh,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "floor": np.floor,
    "pow": np.power,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "select": np.where,
}
BOOLEAN = frozenset({"lt", "le", "eq", "and", "or", "not"})


class Node(NamedTuple):
    """One number: `const` with its value, `load` of element `args[1]` of buffer `args[0]`, or an operation on nodes."""

    op: str
    args: tuple[int, ...] = ()
    value: float = 0.0


class Leaf(NamedTuple):
    """Element offset + Σ strides · indices of a buffer, inside a loop."""

    buffer: int
    offset: int
    strides: tuple[int, ...]


# A leaf, a node's number, or (operation, expression, …).
Expression = Any


class Let(NamedTuple):
    """A node is computed, or written into an element of a buffer where `target` names one."""

    node: int
    target: tuple[int, int] | None = None


@dataclass
class Loop:
    """An array out of arrays: buffer[…] = expression over `shape`, its last axis added up or its maximum taken."""

    buffer: int
    shape: tuple[int, ...]
    expression: Expression
    reduce: str = ""

    @property
    def outer(self) -> tuple[int, ...]:
        """Axes that the result has."""
        return self.shape[:-1] if self.reduce else self.shape


@dataclass
class Program:
    """One function of a model.

    Attributes:
        name: of the function.
        inputs: name -> buffer, in order.
        outputs: name -> nodes.
        nodes: by number; those that steps and outputs need.
        sizes: of every buffer, inputs and tables included.
        tables: buffers that are constants.
        steps: in order.
    """

    name: str
    inputs: dict[str, int]
    outputs: dict[str, list[int]]
    nodes: dict[int, Node]
    sizes: dict[int, int]
    tables: dict[int, Array]
    steps: list[Let | Loop]

    @property
    def buffers(self) -> list[int]:
        """Buffers that the steps fill."""
        loops = {step.buffer for step in self.steps if isinstance(step, Loop)}
        filled = loops | {step.target[0] for step in self.steps if isinstance(step, Let) and step.target is not None}
        return sorted(filled)

    def operations(self) -> Counter[str]:
        """How often each operation is done in one call."""
        count: Counter[str] = Counter()
        for step in self.steps:
            if isinstance(step, Let):
                op = self.nodes[step.node].op
                if step.target is None and op in OPERATIONS:
                    count[op] += 1
            else:
                times = int(np.prod(step.shape))
                for op in operations(step.expression):
                    count[op] += times
                if step.reduce:
                    count[step.reduce] += times
        return count


@dataclass
class Form:
    """One model: programs, and the routines that call them.

    Attributes:
        joints, covariates: headers `name[unit]` in order.
        iterations: steps from the joints to their command.
        method: whose steps these are.
        limit: of the whole |deviation|, `n` [SI].
        dtype: `float64` or `float32`.
        programs: by name.
        routines: by name: `compensate`, `ideal`, and `deviation_sd` where it was asked for.
        facts: lines about the model for a reader: where it came from.
    """

    joints: list[str]
    covariates: list[str]
    iterations: int
    method: str
    limit: Array
    dtype: str
    programs: dict[str, Program]
    routines: dict[str, Routine]
    facts: list[str] = field(default_factory=list)

    @property
    def sd(self) -> bool:
        """Whether there is a routine for the standard deviation."""
        return "deviation_sd" in self.routines

    @property
    def sizes(self) -> dict[str, int]:
        """Of every variable of the routines."""
        sizes: dict[str, int] = {}
        for program in self.programs.values():
            sizes |= {name: program.sizes[buffer] for name, buffer in program.inputs.items()}
            sizes |= {name: len(ids) for name, ids in program.outputs.items()}
        return sizes

    def variables(self, routine: Routine) -> list[str]:
        """Variables that a routine makes."""
        made = [name for call, _ in routine.calls for name in self.programs[call].outputs]
        return [*dict.fromkeys([*made, *(part.target for part in routine.statements if isinstance(part, Copy))])]

    def operations(self) -> Counter[str]:
        """Of one command."""
        count: Counter[str] = Counter()
        for name, times in self.routines["compensate"].calls:
            for op, each in self.programs[name].operations().items():
                count[op] += each * times
        return count


def leaves(expression: Expression) -> Iterator[Leaf | int]:
    """Leaves and nodes of an expression of a loop."""
    if isinstance(expression, tuple) and not isinstance(expression, Leaf):
        for part in expression[1:]:
            yield from leaves(part)
    else:
        yield expression


def operations(expression: Expression) -> Iterator[str]:
    """Operations of an expression of a loop."""
    if isinstance(expression, tuple) and not isinstance(expression, Leaf):
        yield expression[0]
        for part in expression[1:]:
            yield from operations(part)


def live_steps(steps: Iterable[Let | Loop], nodes: Mapping[int, Node], wanted: Collection[int]) -> list[Let | Loop]:
    """Those that the wanted nodes need, in order."""
    needed: set[int] = set()
    kept: list[Let | Loop] = []
    for i in wanted:
        needed |= _made_by(nodes, i)
    for step in reversed([*steps]):
        made = step.buffer if isinstance(step, Loop) else step.node if step.target is None else step.target[0]
        if made not in needed:
            continue
        kept.append(step)
        for leaf in _read(step, nodes):
            needed |= _made_by(nodes, leaf)
    return kept[::-1]


def put_loops_together(
    steps: Sequence[Let | Loop], nodes: Mapping[int, Node], wanted: Collection[int]
) -> list[Let | Loop]:
    """Loops whose array one other loop alone reads become a part of that one, and the array is not stored."""
    readers: dict[int, list[Loop | None]] = {}
    for i in wanted:
        for made in _made_by(nodes, i):
            readers.setdefault(made, []).append(None)
    for step in steps:
        for leaf in _read(step, nodes):
            for made in _made_by(nodes, leaf):
                readers.setdefault(made, []).append(step if isinstance(step, Loop) and isinstance(leaf, Leaf) else None)
    kept: list[Let | Loop] = []
    for step in steps:
        if isinstance(step, Loop) and not step.reduce:
            by = readers.get(step.buffer, [])
            reader = by[0] if by else None
            # What is read twice is worked out twice then.
            if reader is not None and all(r is reader for r in by) and (len(by) == 1 or _is_cheap(step)):
                put = _rewritten(reader.expression, partial(_replaced, step, reader.shape))
                if put is not None:
                    for leaf in leaves(step.expression):
                        if isinstance(leaf, Leaf):
                            others = readers[leaf.buffer]
                            others[:] = [r for r in others if r is not step] + [reader] * len(by)
                    reader.expression = put
                    continue
        kept.append(step)
    return kept


def merge_axes(loop: Loop) -> Loop:
    """The same loop with axes of length 1 left out and axes made one where all that is read follows on."""
    shape, width = [*loop.shape], len(loop.outer)
    every = [leaf for leaf in leaves(loop.expression) if isinstance(leaf, Leaf)]
    strides = {id(leaf): [*leaf.strides] for leaf in every}
    for axis in reversed(range(width)):
        if shape[axis] == 1:
            _drop(shape, strides, axis)
            width -= 1
        elif axis + 1 < width and all(s[axis] == s[axis + 1] * shape[axis + 1] for s in strides.values()):
            shape[axis + 1] *= shape[axis]
            _drop(shape, strides, axis)
            width -= 1
    put = _rewritten(loop.expression, lambda leaf: leaf._replace(strides=tuple(strides[id(leaf)])))
    return Loop(loop.buffer, tuple(shape), put, loop.reduce)


def _rewritten(expression: Expression, change: Callable[[Leaf], Expression | None]) -> Expression | None:
    """An expression with others in the places of its leaves; None where one of these is None."""
    if isinstance(expression, Leaf):
        return change(expression)
    if not isinstance(expression, tuple):
        return expression
    parts = [_rewritten(part, change) for part in expression[1:]]
    return None if None in parts else (expression[0], *parts)


def _drop(shape: list[int], strides: dict[int, list[int]], axis: int) -> None:
    del shape[axis]
    for own in strides.values():
        del own[axis]


def _read(step: Let | Loop, nodes: Mapping[int, Node]) -> Iterable[Leaf | int]:
    """Leaves and nodes that a step reads."""
    if isinstance(step, Loop):
        return leaves(step.expression)
    return nodes[step.node].args if step.target is None else [step.node]


def _made_by(nodes: Mapping[int, Node], leaf: Leaf | int) -> set[int]:
    """The node or the buffer that a step makes for this."""
    if isinstance(leaf, Leaf):
        return {leaf.buffer}
    return {nodes[leaf].args[0]} if nodes[leaf].op == "load" else {leaf}


def _is_cheap(loop: Loop) -> bool:
    inner = loop.expression
    return (
        isinstance(inner, tuple)
        and inner[0] in ("add", "sub", "mul", "neg")
        and all(isinstance(part, Leaf | int) for part in inner[1:])
    )


def _replaced(inner: Loop, shape: tuple[int, ...], at: Leaf) -> Expression | None:
    """What a leaf of a loop over `shape` reads, another loop's expression where that is its array; None where indices
    do not follow on."""
    if at.buffer != inner.buffer:
        return at
    if len(inner.shape) > 1:
        whole = at.offset == 0 and inner.shape == shape and at.strides == _contiguous(inner.shape)
        return inner.expression if whole else None

    def put(leaf: Leaf) -> Leaf:
        step = leaf.strides[0] if leaf.strides else 0
        return Leaf(leaf.buffer, leaf.offset + step * at.offset, tuple(step * s for s in at.strides))

    return _rewritten(inner.expression, put)


def _contiguous(shape: tuple[int, ...]) -> tuple[int, ...]:
    strides, size = [], 1
    for n in reversed(shape):
        strides.append(size)
        size *= n
    return tuple(reversed(strides))
