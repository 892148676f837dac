"""An interpreter of Structured Text over blark's syntax tree, for all rows of an input at once."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from blark.parse import get_parser, parse_source_code
from lark.grammar import Rule
from numpy.typing import NDArray

Array = NDArray[Any]
# A rule of the grammar is one object: to compare its symbols is a fifth of a parser's time.
Rule.__eq__ = object.__eq__

_BINARY: dict[str, Callable[..., Any]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "=": np.equal,
    "<>": np.not_equal,
    "AND": np.logical_and,
    "OR": np.logical_or,
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "SEL": lambda choice, zero, one: np.where(choice, one, zero),
    "LIMIT": lambda low, value, high: np.minimum(np.maximum(value, low), high),
    "MIN": np.minimum,
    "MAX": np.maximum,
    "ABS": np.abs,
    "SQRT": np.sqrt,
    "EXP": np.exp,
    "LN": np.log,
    "SIN": np.sin,
    "COS": np.cos,
    "LREAL_TO_INT": np.rint,
    "REAL_TO_INT": np.rint,
}
_TYPES = {"LREAL": np.float64, "REAL": np.float32, "INT": np.int64, "DINT": np.int64, "BOOL": np.bool_}


def parse_blocks(text: str) -> dict[str, Any]:
    """Function blocks by lower-case name. One after the other: the parser's time grows faster than the text."""
    parser = get_parser().parser.parser
    # What a rule's first symbol expects, that symbol asks for itself: to list it with the rule is to make it again.
    parser.predictions = {name: [r for r in rules if r.origin == name] for name, rules in parser.predictions.items()}
    blocks = re.findall(r"FUNCTION_BLOCK .*?END_FUNCTION_BLOCK", text, re.DOTALL)
    found = [parse_source_code(block).transform().items[0] for block in blocks]
    return {str(block.name).lower(): block for block in found}


class Instance:
    """A function block with its variables, `size x rows` (arrays) or `rows`."""

    def __init__(self, blocks: dict[str, Any], name: str, rows: int) -> None:
        self.block, self.rows = blocks[name.lower()], rows
        self.values: dict[str, Any] = {}
        self.mask = np.ones(rows, dtype=bool)
        for section in self.block.declarations:
            for item in section.items:
                made = self._made(item.init, blocks)
                for variable in item.variables:
                    key = str(variable.variable.name).lower()
                    self.values[key] = made.copy() if isinstance(made, np.ndarray) else made

    def __call__(self, **given: Array) -> None:
        for name, value in given.items():
            old = self.values[name.lower()]
            assert old.shape == np.shape(value), name
            self.values[name.lower()] = np.asarray(value).astype(old.dtype)
        self._run(self.block.body)

    def _made(self, init: Any, blocks: dict[str, Any]) -> Any:
        if type(init).__name__ == "ArrayTypeInitialization":
            (span,) = init.spec.subranges
            size = int(str(span.stop.value)) - int(str(span.start.value)) + 1
            kind = _TYPES[str(init.spec.type.type_name)]
            if init.value is None:
                return np.zeros((size, self.rows), kind)
            numbers = _flat(init.value, self)
            assert len(numbers) == size
            return np.repeat(np.array(numbers, dtype=kind)[:, None], self.rows, 1)
        name = str(init.spec.type)
        if name in _TYPES:
            return np.zeros(self.rows, _TYPES[name])
        return Instance(blocks, name, self.rows)

    def _run(self, statements: Any) -> None:
        for statement in statements.statements:
            getattr(self, f"_{type(statement).__name__}")(statement)

    def _AssignmentStatement(self, statement: Any) -> None:
        (target,) = statement.variables
        value = self.value(statement.expression)
        place, key = self._place(target)
        old = place[key]
        place[key] = np.where(self.mask, value, old).astype(old.dtype)

    def _ForStatement(self, statement: Any) -> None:
        name = str(statement.control.name).lower()
        for k in range(int(self.value(statement.from_)), int(self.value(statement.to)) + 1):
            self.values[name] = np.full(self.rows, k)
            self._run(statement.statements)

    def _IfStatement(self, statement: Any) -> None:
        whole, left = self.mask, self.mask.copy()
        for branch in (statement, *statement.else_ifs):
            chosen = left & self.value(branch.if_expression)
            self.mask, left = chosen, left & ~chosen
            self._run(branch.statements)
        if statement.else_clause is not None:
            self.mask = left
            self._run(statement.else_clause.statements)
        self.mask = whole

    def _FunctionCallStatement(self, statement: Any) -> None:
        given = {str(p.name.name).lower(): self.value(p.value) for p in statement.parameters}
        self.values[str(statement.name.name).lower()](**given)

    def value(self, node: Any) -> Any:
        """Of an expression."""
        kind = type(node).__name__
        if kind == "Real":
            number = float(str(node.value))
            return np.float32(number) if str(node.type_name) == "REAL" else number
        if kind == "Integer":
            return int(str(node.value))
        if kind == "ParenthesizedExpression":
            return self.value(node.expr)
        if kind == "UnaryOperation":
            inner = self.value(node.expr)
            return np.logical_not(inner) if str(node.op).upper() == "NOT" else -inner
        if kind == "BinaryOperation":
            return _BINARY[str(node.op).upper()](self.value(node.left), self.value(node.right))
        if kind == "FunctionCall":
            return _FUNCTIONS[str(node.name.name).upper()](*(self.value(p.value) for p in node.parameters))
        place, key = self._place(node)
        return place[key]

    def _place(self, node: Any) -> tuple[Any, Any]:
        """What holds a variable, and its key there."""
        if type(node).__name__ == "SimpleVariable":
            return self.values, str(node.name).lower()
        place: Any = self.values
        key: Any = str(node.name.name).lower()
        for element in node.elements:
            place = place[key]
            if type(element).__name__ == "FieldSelector":
                place, key = place.values, str(element.field.name).lower()
            else:
                (subscript,) = element.subscripts
                at = np.unique(self.value(subscript))
                assert len(at) == 1 and 0 <= at[0] < len(place), "an index out of its array"
                key = int(at[0])
        return place, key


def _flat(node: Any, instance: Instance) -> list[float]:
    """Numbers of an array's initialisation, which the parser may nest."""
    if type(node).__name__ == "ArrayInitialization":
        return [number for part in node.elements for number in _flat(part.element, instance)]
    return [float(instance.value(node))]
