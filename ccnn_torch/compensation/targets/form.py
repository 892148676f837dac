"""The form of a model that every target prints: typed operations on numbers, loops over arrays, constant tables.

A `Form` has the programs of one model (inputs made finite, the deviation, its standard deviation) and the few numbers
of the fixed point around them. A program is a list of steps in an order in which they can be computed. Each value is
assigned once, all sizes are constants, and there is no branch: a program always does the same operations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
class MachinePrograms:
    """Of a machine that inverts its own forward map.

    Attributes:
        aim: ideal joints -> `aim`.
        towards: (commanded `joints`, `correction`, `aim`, covariates) -> the next `correction`, `excess`, and `doubt`:
            above 0 where this one is not the exact one.
        aim_back: (commanded joints, covariates) -> `aim` of the way back, and `excess`.
        back: (ideal `joints` tried, `correction`, `aim`) -> the next `correction`, and `doubt`.
    """

    aim: Program
    towards: Program
    aim_back: Program
    back: Program

    @property
    def aims(self) -> int:
        """How many numbers an aim has."""
        return len(self.aim.outputs["aim"])


@dataclass
class Form:
    """One model: programs and what stands around them.

    Attributes:
        joints, covariates: headers `name[unit]` in order.
        iterations: steps from the joints to their command.
        limit: of the whole |deviation|, `n` [SI].
        slack: how far command + deviation may be from the joints before the model is not trusted, `n` [SI].
        fallback_sd: standard deviation where the deviation is taken as 0, `n` [SI].
        dtype: `float64` or `float32`.
        clean: (given joints and covariates) -> finite `joints`, `covariates`, and how many were not, `strange`.
        deviation: (commanded joints, covariates) -> `deviation`, and `excess`: above 0 outside the domain.
        secant: (`found` deviation, `correction`, `steps` before) -> the next `correction` and `steps`; None where that
            correction is the deviation that was found.
        spread: (commanded joints, covariates) -> `sd`; None where it was not asked for.
        machine: programs in the place of `deviation`; None without a machine.
        facts: lines about the model for a reader: where it came from.
    """

    joints: list[str]
    covariates: list[str]
    iterations: int
    limit: Array
    slack: Array
    fallback_sd: Array
    dtype: str
    clean: Program
    deviation: Program
    secant: Program | None
    spread: Program | None
    machine: MachinePrograms | None = None
    facts: list[str] = field(default_factory=list)

    @property
    def programs(self) -> list[Program]:
        """Those that there are."""
        deviation = [self.deviation, self.secant]
        if self.machine is not None:
            own = self.machine
            deviation = [own.aim, own.towards, own.aim_back, own.back, self.secant]
        return [p for p in (self.clean, *deviation, self.spread) if p is not None]

    @property
    def kept(self) -> int:
        """How many numbers `secant` takes with it from step to step."""
        return len(self.secant.outputs["steps"]) if self.secant else 0

    def operations(self) -> Counter[str]:
        """Of one command."""
        count = self.clean.operations()
        calls_of = [(self.deviation, self.iterations + 1), (self.secant, self.iterations)]
        if self.machine is not None:
            calls_of = [(self.machine.aim, 1), (self.machine.towards, self.iterations + 1), calls_of[1]]
        for program, calls in calls_of:
            for op, times in (program.operations() if program else {}).items():
                count[op] += times * calls
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
