"""A form as IEC 61131-3 Structured Text: function blocks, a self-test, and how to put them into a task."""

from __future__ import annotations

import math

import numpy as np

from ccnn_torch.compensation.routines import Routine
from ccnn_torch.compensation.targets.form import Array, Form, Program
from ccnn_torch.compensation.targets.golden import Golden
from ccnn_torch.compensation.targets.printing import (
    ARITHMETIC,
    Dialect,
    Text,
    costs,
    filled,
    print_program,
    routine_lines,
    within,
    wrapped,
)
from ccnn_torch.errors import MethodFailedError

# An argument of EXP beyond these would stop a controller; what it gives is 0 or without effect long before.
_EXP = {"float64": 700.0, "float32": 80.0}
# Golden vectors in the self-test: enough to find a mistake in copying, few enough for a small controller.
_TESTED = 8
_NAMES = ("abs", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan")


def print_structured_text(form: Form, golden: Golden) -> dict[str, str]:
    """Contents of the files by name."""
    dialect, tables = _dialect(form.dtype), dict[bytes, str]()
    about = [*form.facts, "", *_units(form), "", *costs(form)]
    comment = "\n".join(["(*", *(f"   {line}".rstrip() for line in wrapped(about)), "*)"])
    blocks = [_block(program, print_program(program, dialect, tables), form) for program in form.programs.values()]
    text = "\n\n".join([comment, *blocks, *(_routine(routine, form) for routine in form.routines.values())]) + "\n"
    readme = filled("structured_text.md.jinja", real=_real(form))
    return {"compensator.st": text, "selftest.st": _selftest(form, golden), "README.md": readme}


def _real(form: Form) -> str:
    return "LREAL" if form.dtype == "float64" else "REAL"


def _literal(value: float, dtype: str) -> str:
    if math.isnan(value):
        raise MethodFailedError("st has no constant that is no number, which this model needs; export it as c99")
    # It has no infinity: what is as large as no number is stands for it.
    value = within(value, dtype) if math.isfinite(value) else math.copysign(float(np.finfo(dtype).max), value)
    mantissa, _, exponent = (repr(value) if dtype == "float64" else str(np.float32(value))).partition("e")
    mantissa = mantissa if "." in mantissa else f"{mantissa}.0"
    sign, mantissa = ("-", mantissa[1:]) if mantissa.startswith("-") else ("", mantissa)
    text = ("REAL#" if dtype == "float32" else "") + sign + mantissa + (f"E{int(exponent)}" if exponent else "")
    return f"({text})" if text.startswith("-") else text


def _dialect(dtype: str) -> Dialect:
    def literal(value: float) -> str:
        return _literal(value, dtype)

    most = literal(_EXP[dtype])
    exp = f"EXP(LIMIT({literal(-_EXP[dtype])}, {{0}}, {most}))"
    one, two = literal(1.0), literal(2.0)
    twice = exp.format(f"{two} * {{0}}")
    operations = {name: f"{name.upper()}({{0}})" for name in _NAMES}
    operations |= ARITHMETIC
    operations |= {
        "min": "MIN({0}, {1})",
        "max": "MAX({0}, {1})",
        "exp": exp,
        "log": "LN({0})",
        "pow": "EXPT({0}, {1})",
        "tanh": f"({one} - {two} / ({one} + {twice}))",
        "eq": "({0} = {1})",
        "and": "({0} AND {1})",
        "or": "({0} OR {1})",
        "not": "(NOT {0})",
        "select": "SEL({0}, {2}, {1})",
    }
    return Dialect(
        "st",
        operations,
        literal,
        lambda name, value, truth: f"{name} := {value};",
        lambda place, value: f"{place} := {value};",
        lambda index, count, lines: [
            f"FOR {index} := 0 TO {count - 1} DO",
            *(f"    {line}" for line in lines),
            "END_FOR",
        ],
        "{0}[{1}]",
    )


def _units(form: Form) -> list[str]:
    return [
        "Inputs and outputs are in SI units, in this order. Joints: " + ", ".join(form.joints) + ".",
        "Covariates: " + (", ".join(form.covariates) or "none; leave the input as it is") + ".",
        "Status 0: the command is inside the domain of the training rows. 1: outside, where what was learned fades "
        "into the safe correction, or the model broke its limit, and then command = joints. 2: an input is not finite, "
        "and then command = joints, with the middle of the domain for what is no number and its edge for infinity. 3: "
        "near a singular pose or at a limit of the joints, and the command is the nearest safe one.",
    ]


def _array(name: str, size: int, real: str) -> str:
    return f"    {name} : ARRAY[0..{max(size, 1) - 1}] OF {real};"


def _table(name: str, values: Array, form: Form) -> str:
    flat = [_literal(float(v), form.dtype).strip("()") for v in values.ravel()]
    rows = ",\n        ".join(", ".join(flat[k : k + 4]) for k in range(0, len(flat), 4))
    return f"    {name} : ARRAY[0..{len(flat) - 1}] OF {_real(form)} := [\n        {rows}];"


def _section(kind: str, lines: list[str]) -> list[str]:
    return [kind, *lines, "END_VAR"] if lines else []


def _block(program: Program, text: Text, form: Form) -> str:
    """A program as a function block of arrays."""
    real = _real(form)
    names = {truth: [name for name, kind in text.numbers.items() if kind == truth] for truth in (False, True)}
    variables = [_array(name, size, real) for name, size in text.buffers.items()]
    for truth, kind in ((False, real), (True, "BOOL")):
        rows = [names[truth][k : k + 12] for k in range(0, len(names[truth]), 12)]
        variables += [f"    {', '.join(row)} : {kind};" for row in rows]
    variables += [f"    {', '.join(f'i{d}' for d in range(text.indices))} : DINT;"] if text.indices else []
    variables += [f"    sum : {real};"] if text.sums else []
    return "\n".join(
        [
            f"FUNCTION_BLOCK CCNN_{program.name.capitalize()}_",
            *_section("VAR_INPUT", [_array(name, program.sizes[b], real) for name, b in program.inputs.items()]),
            *_section("VAR_OUTPUT", [_array(f"{k}_out", len(ids), real) for k, ids in program.outputs.items() if ids]),
            *_section("VAR CONSTANT", [_table(name, values, form) for name, values in text.tables.items()]),
            *_section("VAR", variables),
            *text.lines,
            "END_FUNCTION_BLOCK",
        ]
    )


def _routine(routine: Routine, form: Form) -> str:
    """What a user calls, as a function block; the programs are instances in it."""
    real, sizes, dialect = _real(form), form.sizes, _dialect(form.dtype)
    programs = dict.fromkeys(name for name, _ in routine.calls)
    # Where a variable is: an output of an instance, or an array of its own.
    places = {variable: f"{name}_block.{variable}_out" for name in programs for variable in form.programs[name].outputs}
    own = [name for name in form.variables(routine) if name not in places]
    places = {name: name for name in (*own, "covariates")} | {"given": routine.given} | places

    def call(name: str) -> str:
        given = ", ".join(f"{i} := {places[i]}" for i in form.programs[name].inputs)
        return f"{name}_block({given});"

    lines = routine_lines(routine, form, dialect, call, places)
    for name in routine.returns:
        lines += dialect.loop("j", sizes[name], [f"{name}[j] := {places[name]}[j];"])
    inputs = {routine.given: len(form.joints), "covariates": len(form.covariates)}
    outputs = [_array(name, sizes[name], real) for name in routine.returns]
    variables = [f"    {name}_block : CCNN_{name.capitalize()}_;" for name in programs]
    variables += [*(_array(name, sizes[name], real) for name in own), "    j, k : DINT;"]
    return "\n".join(
        [
            f"(* {routine.about} *)",
            f"FUNCTION_BLOCK CCNN_{''.join(part.capitalize() for part in routine.name.split('_'))}",
            *_section("VAR_INPUT", [_array(name, size, real) for name, size in inputs.items()]),
            *_section("VAR_OUTPUT", [*outputs, "    status : INT;"]),
            *_section("VAR", variables),
            *lines,
            f"status := {real}_TO_INT({places['status']}[0]);",
            "END_FUNCTION_BLOCK",
        ]
    )


def _selftest(form: Form, golden: Golden) -> str:
    """Some golden vectors as a function block: finite ones, half of them at the edges of the domain."""
    usual = (np.abs(np.hstack([golden.joints, golden.covariates])) < 1e30).all(-1)
    finite = np.flatnonzero(usual & (golden.outputs["status"] != 3))
    rows = finite[np.linspace(0, len(finite) - 1, _TESTED).astype(int)]
    tables = {name: golden.outputs[name][rows] for name in ("command", "deviation")}
    tables = {"joints": golden.joints[rows], **tables, "tolerance": golden.tolerance}
    if form.covariates:
        tables["covariates"] = golden.covariates[rows]
    return filled(
        "selftest.st.jinja",
        tables=[_table(f"golden_{name}", values, form) for name, values in tables.items()],
        status=golden.outputs["status"][rows].tolist(),
        count=_TESTED,
        rounding=_literal(4 * float(np.finfo(form.dtype).eps), form.dtype),
        n=len(form.joints),
        m=len(form.covariates),
        real=_real(form),
    )
