"""What the printers of all targets share: a program's steps as text, and the numbers that a reader wants to know."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ccnn_torch.compensation.routines import Copy, Routine, Statement
from ccnn_torch.compensation.targets.form import BOOLEAN, Array, Expression, Form, Leaf, Let, Loop, Program, leaves
from ccnn_torch.display import plain
from ccnn_torch.errors import MethodFailedError

if TYPE_CHECKING:
    from jinja2 import Environment
# What is used once is written where it is used, up to so many characters.
_LONGEST = 90
# What is written alike everywhere.
ARITHMETIC = {
    "add": "({0} + {1})",
    "sub": "({0} - {1})",
    "mul": "({0} * {1})",
    "div": "({0} / {1})",
    "neg": "(-{0})",
    "lt": "({0} < {1})",
    "le": "({0} <= {1})",
}
# Operations as a reader counts them.
_COUNTED = {
    "additions and multiplications": ("add", "sub", "mul", "neg"),
    "divisions": ("div",),
    "comparisons and choices": ("min", "max", "abs", "lt", "le", "eq", "and", "or", "not", "select", "floor"),
    "roots": ("sqrt",),
    "exponentials and logarithms": ("exp", "log", "tanh", "pow"),
    "sines and cosines": ("sin", "cos", "tan", "asin", "acos", "atan", "atan2"),
}


def filled(template: str, **values: Any) -> str:
    """A file's text; a name in the template that no value has is an error."""
    return _environment().get_template(template).render(**values)


@cache
def _environment() -> Environment:
    # Loaded with the package by everybody who compensates, and needed by who exports alone.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("ccnn_torch.compensation.targets"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


@dataclass(frozen=True)
class Dialect:
    """How a target writes things.

    Attributes:
        name: of the target, for messages.
        operations: operation -> template with {0}, {1}, …
        literal: of a number.
        assign: (name, expression, whether it is a truth value) -> line.
        store: (place, expression) -> line.
        loop: (index, count, lines within) -> lines.
        index: of an element, template with {0} the array and {1} the index.
    """

    name: str
    operations: Mapping[str, str]
    literal: Callable[[float], str]
    assign: Callable[[str, str, bool], str]
    store: Callable[[str, str], str]
    loop: Callable[[str, int, list[str]], list[str]]
    index: str


@dataclass
class Text:
    """A program as text.

    Attributes:
        lines: in order.
        numbers: names of the numbers that they assign -> whether these are truth values.
        buffers: names of the arrays that they fill, with their sizes.
        tables: names of the constant arrays that they read.
        indices: the deepest nest of loops has so many.
        sums: whether a loop adds up.
    """

    lines: list[str]
    numbers: dict[str, bool]
    buffers: dict[str, int]
    tables: dict[str, Array]
    indices: int = 0
    sums: bool = False


def print_program(program: Program, dialect: Dialect, tables: dict[bytes, str]) -> Text:
    """The steps, and then its outputs into arrays of their names.

    Args:
        tables: names of tables by content, of all programs so far; grows.

    Raises:
        MethodFailedError: the target lacks an operation.
    """
    names = {buffer: name for name, buffer in program.inputs.items()}
    names |= {start: tables.setdefault(v.tobytes(), f"table{len(tables)}") for start, v in program.tables.items()}
    names |= {buffer: f"array{k}" for k, buffer in enumerate(program.buffers)}
    constants = {names[start]: values for start, values in program.tables.items()}
    out = Text([], {}, {names[buffer]: program.sizes[buffer] for buffer in program.buffers}, constants)
    texts: dict[int, str] = {}
    uses, looped = _uses(program)

    def written(op: str, parts: list[str]) -> str:
        if op not in dialect.operations:
            raise MethodFailedError(f"{dialect.name} has no '{op}', which this model needs; export it as c99")
        return dialect.operations[op].format(*parts)

    def text(i: int) -> str:
        node = program.nodes[i]
        if node.op == "const":
            return dialect.literal(node.value)
        if node.op == "load":
            return dialect.index.format(names[node.args[0]], node.args[1])
        return texts[i]

    def inner(part: Expression) -> str:
        if isinstance(part, Leaf):
            terms = [f"{s} * i{d}" if s != 1 else f"i{d}" for d, s in enumerate(part.strides) if s]
            terms += [str(part.offset)] if part.offset or not terms else []
            return dialect.index.format(names[part.buffer], " + ".join(terms))
        return written(part[0], [inner(p) for p in part[1:]]) if isinstance(part, tuple) else text(part)

    for step in program.steps:
        if isinstance(step, Let) and step.target is not None:
            place = dialect.index.format(names[step.target[0]], step.target[1])
            out.lines.append(dialect.store(place, _bare(text(step.node))))
        elif isinstance(step, Let):
            node = program.nodes[step.node]
            value = written(node.op, [text(i) for i in node.args])
            if uses[step.node] == 1 and step.node not in looped and len(value) <= _LONGEST:
                texts[step.node] = value
                continue
            texts[step.node] = name = f"v{len(out.numbers)}"
            out.numbers[name] = node.op in BOOLEAN
            out.lines.append(dialect.assign(name, _bare(value), out.numbers[name]))
        else:
            out.indices, out.sums = max(out.indices, len(step.shape)), out.sums or bool(step.reduce)
            out.lines += _loop_lines(step, dialect, names[step.buffer], _bare(inner(step.expression)))
    for name, ids in program.outputs.items():
        for k, i in enumerate(ids):
            out.lines.append(dialect.store(dialect.index.format(f"{name}_out", k), _bare(text(i))))
    return out


def routine_lines(
    routine: Routine, form: Form, dialect: Dialect, call: Callable[[str], str], places: Mapping[str, str]
) -> list[str]:
    """The statements of a routine.

    Args:
        call: name of a program -> line.
        places: where variables are that are in no array of their own name.
    """

    def printed(statement: Statement) -> list[str]:
        if isinstance(statement, str):
            return [call(statement)]
        if isinstance(statement, Copy):
            target = dialect.index.format(statement.target, "j")
            source = dialect.index.format(places.get(statement.source, statement.source), "j")
            line = dialect.store(target, source if statement.source else dialect.literal(0.0))
            return dialect.loop("j", form.sizes[statement.target], [line])
        return dialect.loop("k", statement.times, [line for part in statement.statements for line in printed(part)])

    return [line for statement in routine.statements for line in printed(statement)]


def _loop_lines(step: Loop, dialect: Dialect, name: str, value: str) -> list[str]:
    at, size = [], 1
    for d, n in reversed([*enumerate(step.outer)]):
        at.append(f"{size} * i{d}" if size != 1 else f"i{d}")
        size *= n
    place = dialect.index.format(name, " + ".join(reversed(at)) or "0")
    lines = [dialect.store(place, value)]
    if step.reduce:
        start, more = 0.0, f"sum + {value}"
        if step.reduce != "add":
            # Lowest number of single precision: the first is above it.
            start, more = -3e38, dialect.operations[step.reduce].format("sum", value)
        inner = dialect.loop(f"i{len(step.outer)}", step.shape[-1], [dialect.store("sum", more)])
        lines = [dialect.store("sum", dialect.literal(start)), *inner, dialect.store(place, "sum")]
    for d, n in reversed([*enumerate(step.outer)]):
        lines = dialect.loop(f"i{d}", n, lines)
    return lines


def _uses(program: Program) -> tuple[Counter[int], set[int]]:
    """How often each node is read, and which are within a loop."""
    uses: Counter[int] = Counter()
    looped: set[int] = set()
    for step in program.steps:
        if isinstance(step, Loop):
            looped |= {leaf for leaf in leaves(step.expression) if not isinstance(leaf, Leaf)}
        else:
            uses.update(program.nodes[step.node].args if step.target is None else [step.node])
    for ids in program.outputs.values():
        uses.update(ids)
    return uses, looped


def _bare(text: str) -> str:
    """Without the outer parentheses, where they are one pair."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for k, c in enumerate(text):
        depth += (c == "(") - (c == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1]


def within(value: float, dtype: str) -> float:
    """A finite number that the type can hold."""
    most = float(np.finfo(dtype).max)
    return float(np.clip(value, -most, most)) if math.isfinite(value) else value


def costs(form: Form) -> list[str]:
    """Lines for the head of a file: tables, arrays and operations of one command."""
    count = form.operations()
    width = 8 if form.dtype == "float64" else 4
    tables = {values.tobytes(): len(values) for program in form.programs.values() for values in program.tables.values()}
    arrays = max(sum(program.sizes[b] for b in program.buffers) for program in form.programs.values())
    parts = {what: sum(count[op] for op in ops) for what, ops in _COUNTED.items()}
    return [
        f"Tables: {width * sum(tables.values())} bytes. Arrays at work: {width * arrays} bytes at most.",
        f"Operations of one command ({form.iterations} steps of {form.method}), always the same: "
        + ", ".join(f"{times} {what}" for what, times in parts.items() if times)
        + ".",
    ]


def wrapped(lines: list[str]) -> list[str]:
    """Sentences in lines of a comment, which no name from a model file can end."""
    wrapper = textwrap.TextWrapper(96, break_long_words=False, break_on_hyphens=False)
    return [part for line in lines for part in (wrapper.wrap(plain(line)) or [""])]
