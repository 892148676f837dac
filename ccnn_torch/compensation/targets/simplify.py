"""Passes over the steps of a program: dead ones are left out, neighbouring loops become one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

from ccnn_torch.compensation.targets.form import Expression, Leaf, Let, Loop, Node, leaves


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
                put = _replaced(reader.expression, step, reader.shape)
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

    def put(part: Expression) -> Expression:
        if isinstance(part, Leaf):
            return Leaf(part.buffer, part.offset, tuple(strides[id(part)]))
        return (part[0], *map(put, part[1:])) if isinstance(part, tuple) else part

    return Loop(loop.buffer, tuple(shape), put(loop.expression), loop.reduce)


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


def _replaced(expression: Expression, inner: Loop, shape: tuple[int, ...]) -> Expression | None:
    """The expression with another loop's in the place of its array; None where indices do not follow on."""
    if isinstance(expression, Leaf):
        if expression.buffer != inner.buffer:
            return expression
        moved = _moved(inner, expression, shape)
        return moved
    if isinstance(expression, tuple):
        parts = [_replaced(part, inner, shape) for part in expression[1:]]
        return None if any(part is None for part in parts) else (expression[0], *parts)
    return expression


def _moved(inner: Loop, at: Leaf, shape: tuple[int, ...]) -> Expression | None:
    """The inner expression at the elements that a leaf of a loop over `shape` reads."""
    along = _contiguous(inner.shape)
    if len(inner.shape) > 1 and not (at.offset == 0 and inner.shape == shape and at.strides == along):
        return None

    def put(part: Expression) -> Expression:
        if isinstance(part, Leaf):
            if len(inner.shape) > 1:
                return part
            step = part.strides[0] if part.strides else 0
            return Leaf(part.buffer, part.offset + step * at.offset, tuple(step * s for s in at.strides))
        return (part[0], *map(put, part[1:])) if isinstance(part, tuple) else part

    return put(inner.expression)


def _contiguous(shape: tuple[int, ...]) -> tuple[int, ...]:
    strides, size = [], 1
    for n in reversed(shape):
        strides.append(size)
        size *= n
    return tuple(reversed(strides))
