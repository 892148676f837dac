"""A form run on rows of inputs in numpy: what every target must give, and the check that a form is its model's."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ccnn_torch.compensation.routines import Copy, Statement
from ccnn_torch.compensation.targets.form import OPERATIONS, Array, Expression, Form, Leaf, Let, Program

# Numbers at a time: a loop over a large table holds all its products of every row.
_AT_ONCE = 1 << 18
# Outputs of the way back, as a form's user calls them.
_BACK = {"joints": "ideal", "status": "ideal_status"}


def run_program(program: Program, inputs: dict[str, Array], dtype: str = "float64") -> dict[str, Array]:
    """Outputs `s x size` of inputs `s x size`."""
    rows = len(next(iter(inputs.values())))
    largest = max((math.prod(step.shape) for step in program.steps if not isinstance(step, Let)), default=1)
    some = max(1, _AT_ONCE // largest)
    parts = [
        _run({name: value[k : k + some] for name, value in inputs.items()}, program, dtype)
        for k in range(0, rows, some)
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in program.outputs}


@np.errstate(all="ignore")
def _run(inputs: dict[str, Array], program: Program, dtype: str) -> dict[str, Array]:
    rows = len(next(iter(inputs.values())))
    buffers = {program.inputs[name]: value.astype(dtype) for name, value in inputs.items()}
    buffers |= {k: np.broadcast_to(v.astype(dtype), (rows, len(v))) for k, v in program.tables.items()}
    for k in program.buffers:
        buffers[k] = np.empty((rows, program.sizes[k]), dtype)
    numbers: dict[int, Array] = {}

    def number(i: int) -> Array:
        node = program.nodes[i]
        if node.op == "const":
            return np.full(rows, node.value, dtype)
        if node.op == "load":
            return buffers[node.args[0]][:, node.args[1]]
        return numbers[i]

    def array(part: Expression, shape: tuple[int, ...]) -> Array:
        if isinstance(part, Leaf):
            at = np.full((), part.offset)
            for step, n in zip(part.strides, shape, strict=True):
                at = at[..., None] + step * np.arange(n)
            return buffers[part.buffer][:, at]
        if isinstance(part, tuple):
            return np.asarray(OPERATIONS[part[0]](*(array(p, shape) for p in part[1:])))
        return number(part).reshape(-1, *[1] * len(shape))

    for step in program.steps:
        if isinstance(step, Let) and step.target is not None:
            buffers[step.target[0]][:, step.target[1]] = number(step.node)
        elif isinstance(step, Let):
            node = program.nodes[step.node]
            numbers[step.node] = np.asarray(OPERATIONS[node.op](*map(number, node.args)))
        else:
            found = np.broadcast_to(array(step.expression, step.shape), (rows, *step.shape))
            if step.reduce:
                found = found.sum(-1) if step.reduce == "add" else found.max(-1)
            buffers[step.buffer][:] = found.reshape(rows, -1)
    return {
        name: np.stack([number(i) for i in ids], -1) if ids else np.zeros((rows, 0), dtype)
        for name, ids in program.outputs.items()
    }


@np.errstate(all="ignore")
def run_form(form: Form, joints: Array, covariates: Array | None) -> dict[str, Array]:
    """What each target does: `command`, `deviation`, `ideal` and `sd` (`s x n`), `status` and `ideal_status` (`s`).

    Args:
        joints: ideal joints for the command and its `deviation` and `status`, commanded ones for the others, `s x n`.
        covariates: `s x m`; None where they are missing.
    """
    given = np.full((len(joints), len(form.covariates)), np.nan) if covariates is None else covariates
    out = run_routine(form, "compensate", joints, given)
    out |= {_BACK[name]: value for name, value in run_routine(form, "ideal", joints, given).items()}
    if form.sd:
        out["sd"] = run_routine(form, "deviation_sd", joints, given)["sd"]
    return out


def run_routine(form: Form, name: str, joints: Array, covariates: Array) -> dict[str, Array]:
    """What one routine gives: `s x n` each, and `status` `s`."""
    routine = form.routines[name]
    values = {"given": joints, "covariates": covariates}

    def run(statements: Sequence[Statement]) -> None:
        for statement in statements:
            if isinstance(statement, str):
                program = form.programs[statement]
                values.update(run_program(program, {key: values[key] for key in program.inputs}, form.dtype))
            elif isinstance(statement, Copy):
                zeros = np.zeros((len(joints), form.sizes[statement.target]), form.dtype)
                values[statement.target] = values[statement.source] if statement.source else zeros
            else:
                for _ in range(statement.times):
                    run(statement.statements)

    run(routine.statements)
    return {key: values[key] for key in routine.returns} | {"status": values["status"][:, 0].astype(int)}
