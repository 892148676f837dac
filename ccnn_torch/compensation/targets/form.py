"""The form of a model that every target prints: typed operations on numbers, loops over arrays, constant tables.

A `Form` has the functions of one model (inputs made finite, a step towards the command, its end) as programs, and the
routines that call them. A program is a list of steps in an order in which they can be computed. Each value is assigned
once, all sizes are constants, and there is no branch: a program always does the same operations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
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
        fallback_sd: standard deviation where the deviation is taken as 0, `n` [SI].
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
    fallback_sd: Array
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
