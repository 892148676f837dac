"""A form run on rows of inputs in numpy: what every target must give, and the check that a form is its model's."""

from __future__ import annotations

import math

import numpy as np

from ccnn_torch.compensation.machine.machine import ASTRAY
from ccnn_torch.compensation.targets.form import (
    OPERATIONS,
    Array,
    Expression,
    Form,
    Leaf,
    Let,
    MachinePrograms,
    Program,
)

# Numbers at a time: a loop over a large table holds all its products of every row.
_AT_ONCE = 1 << 18


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
    n, m = len(form.joints), len(form.covariates)
    given = np.full((len(joints), m), np.nan) if covariates is None else covariates
    cleaned = run_program(form.clean, {"joints": joints} | ({"covariates": given} if m else {}), form.dtype)
    q, strange = cleaned["joints"], cleaned["strange"][:, 0] > 0
    more = {"covariates": cleaned["covariates"]} if m else {}

    if form.machine is not None:
        return _run_machine(form, form.machine, q, strange, more)

    def deviation(at: Array) -> tuple[Array, Array]:
        found = run_program(form.deviation, {"joints": at} | more, form.dtype)
        return found["deviation"], found["excess"][:, 0]

    first, first_excess = last, excess = deviation(q)
    command, correction, steps = q, np.zeros_like(q), np.zeros((len(q), form.kept), form.dtype)
    for _ in range(form.iterations):
        if form.secant is None:
            correction = last
        else:
            before = {"found": last, "correction": correction, "steps": steps}
            correction, steps = run_program(form.secant, before, form.dtype).values()
        command = q - correction
        last, excess = deviation(command)
    eps = np.finfo(form.dtype).eps
    trusted = np.abs(command + last - q) <= form.slack + 8 * eps * (np.abs(q) + np.abs(last))
    good = (trusted & (np.abs(last) <= form.limit * (1 + 1e-9))).all(-1) & ~strange
    back = (np.abs(first) <= form.limit * (1 + 1e-9)).all(-1) & ~strange
    out = {
        "command": np.where(good[:, None], command, q),
        "deviation": np.where(good[:, None], last, 0),
        "ideal": np.where(back[:, None], q + first, q),
        "status": np.where(strange, 2, np.where(good & (excess <= 0), 0, 1)),
        "ideal_status": np.where(strange, 2, np.where(back & (first_excess <= 0), 0, 1)),
    }
    out |= _spread(form, q, strange, more)
    assert all(value.shape[-1] == n for name, value in out.items() if "status" not in name)
    return out


def _spread(form: Form, q: Array, strange: Array, more: dict[str, Array]) -> dict[str, Array]:
    """Standard deviation at commanded joints, where it was asked for."""
    if form.spread is None:
        return {}
    sd = run_program(form.spread, {"joints": q} | more, form.dtype)["sd"]
    finite = (np.isfinite(sd) & (sd >= 0)).all(-1) & ~strange
    return {"sd": np.where(finite[:, None], sd, form.fallback_sd)}


def _run_machine(
    form: Form, machine: MachinePrograms, q: Array, strange: Array, more: dict[str, Array]
) -> dict[str, Array]:
    """As `run_form` for a machine, of finite joints."""
    aim = run_program(machine.aim, {"joints": q}, form.dtype)["aim"]
    back = run_program(machine.aim_back, {"joints": q} | more, form.dtype)

    def towards(correction: Array) -> dict[str, Array]:
        given = {"joints": q - correction, "correction": correction, "aim": aim}
        return run_program(machine.towards, given | more, form.dtype)

    def tried(correction: Array) -> dict[str, Array]:
        given = {"joints": q - correction, "correction": correction, "aim": back["aim"]}
        return run_program(machine.back, given, form.dtype)

    out = {}
    for names, step in ((("command", "status"), towards), (("ideal", "ideal_status"), tried)):
        first = last = step(np.zeros_like(q))
        correction, kept = np.zeros_like(q), np.zeros((len(q), form.kept), form.dtype)
        for _ in range(form.iterations):
            if form.secant is not None and step is towards:
                before = {"found": last["correction"], "correction": correction, "steps": kept}
                correction, kept = run_program(form.secant, before, form.dtype).values()
            else:
                correction = last["correction"]
            last = step(correction)
        small = (np.abs(correction) <= form.limit * (1 + 1e-9)).all(-1, keepdims=True)
        good = (last["doubt"] <= ASTRAY) & small
        correction = np.where(good, correction, first["correction"])
        excess = np.where(good, last["excess"], first["excess"]) if "excess" in last else back["excess"]
        correction = np.where(strange[:, None], 0, correction)
        out[names[0]] = q - correction
        state = np.where(last["doubt"] <= 0, np.where(excess <= 0, 0, 1), 3)[:, 0]
        out[names[1]] = np.where(strange, 2, state)
        if names[0] == "command":
            out["deviation"] = correction
    return out | _spread(form, q, strange, more)
