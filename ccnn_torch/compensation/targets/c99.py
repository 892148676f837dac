"""A form as C99: a header, a source, a self-test with the golden vectors, and a Makefile."""

from __future__ import annotations

import numpy as np

from ccnn_torch.compensation.routines import Routine
from ccnn_torch.compensation.targets.form import Array, Form, Program
from ccnn_torch.compensation.targets.golden import DAMPED_TOLERANCE, Golden
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

_NAMES = ("sqrt", "exp", "log", "sin", "cos", "tan", "tanh", "asin", "acos", "atan", "floor")
_FUNCTIONS = {name: f"{name}{{s}}({{{{0}}}})" for name in _NAMES}
_FUNCTIONS |= {"abs": "fabs{s}({{0}})", "atan2": "atan2{s}({{0}}, {{1}})", "pow": "pow{s}({{0}}, {{1}})"}
_OPERATIONS = ARITHMETIC | {
    "min": "ccnn_min({0}, {1})",
    "max": "ccnn_max({0}, {1})",
    "eq": "({0} == {1})",
    "and": "({0} && {1})",
    "or": "({0} || {1})",
    "not": "(!{0})",
    "select": "({0} ? {1} : {2})",
}


def print_c99(form: Form, golden: Golden) -> dict[str, str]:
    """Contents of the files by name."""
    return {
        "compensator.h": _header(form),
        "compensator.c": filled("compensator.c.jinja", compensation=c_compensation(form)),
        "selftest.c": _selftest(form, golden),
        "Makefile": filled("Makefile.jinja"),
    }


def c_dialect(dtype: str) -> Dialect:
    """How C is written in double or single precision."""
    single = dtype == "float32"

    def literal(value: float) -> str:
        if np.isnan(value):
            return "NAN"
        if np.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        text = f"{np.float32(within(value, dtype))!s}f" if single else repr(float(value))
        return f"({text})" if text.startswith("-") else text

    return Dialect(
        "c99",
        _OPERATIONS | {name: text.format(s="f" if single else "") for name, text in _FUNCTIONS.items()},
        literal,
        lambda name, value, truth: f"const {'int' if truth else 'ccnn_real'} {name} = {value};",
        lambda place, value: f"{place} = {value};",
        lambda index, count, lines: [
            f"for (int {index} = 0; {index} < {count}; {index}++) {{",
            *(f"    {line}" for line in lines),
            "}",
        ],
        "{0}[{1}]",
    )


def _comment(lines: list[str]) -> str:
    return "\n".join(["/*", *(f" * {line}".rstrip() for line in wrapped(lines)), " */"])


def _header(form: Form) -> str:
    about = [
        *form.facts,
        "",
        "Inputs and outputs are in SI units, in this order. Joints: " + ", ".join(form.joints) + ".",
        "Covariates: " + (", ".join(form.covariates) or "none (give NULL)") + ".",
        "",
        *costs(form),
        "No heap, no recursion, no global state; each array is of fixed size. An output may be the same array as an "
        "input. Do not compile with -ffast-math: the check for numbers that are none would be left out.",
    ]
    return filled(
        "compensator.h.jinja",
        about=_comment(about),
        real="double" if form.dtype == "float64" else "float",
        joints=len(form.joints),
        covariates=len(form.covariates),
        sd=form.sd,
    )


def _arguments(program: Program) -> str:
    outputs = [f"ccnn_real {name}_out[]" for name, ids in program.outputs.items() if ids]
    return ", ".join([*(f"const ccnn_real {name}[]" for name in program.inputs), *outputs])


def c_function(program: Program, text: Text) -> str:
    """A program as a static function of arrays."""
    body = [f"    {line}" for line in text.lines]
    before = [f"    ccnn_real {name}[{size}];" for name, size in text.buffers.items()]
    before += ["    ccnn_real sum;"] if text.sums else []
    joined = "\n".join(body)
    before += [f"    (void){name};" for name in program.inputs if f"{name}[" not in joined]
    return "\n".join([f"static void ccnn_{program.name}({_arguments(program)})", "{", *before, *body, "}"])


def c_constants(name: str, values: Array, dialect: Dialect) -> str:
    """A table."""
    flat = [dialect.literal(float(v)) for v in values.ravel()]
    rows = [", ".join(flat[k : k + 4]) for k in range(0, len(flat), 4)]
    return f"static const ccnn_real {name}[{len(flat)}] = {{\n    " + ",\n    ".join(rows) + "\n};"


def c_compensation(form: Form, static: str = "") -> str:
    """The functions of the compensation; `static` comes before each, where they are a part of another file."""
    dialect, tables = c_dialect(form.dtype), dict[bytes, str]()
    texts = {name: print_program(program, dialect, tables) for name, program in form.programs.items()}
    functions = [c_function(program, texts[name]) for name, program in form.programs.items()]
    functions += [_routine(routine, form, dialect, static) for routine in form.routines.values()]
    numbers = {k: v for text in texts.values() for k, v in text.tables.items()}
    parts = [c_constants(name, values, dialect) for name, values in numbers.items()]
    for name, sign in (("min", "<"), ("max", ">")):
        if any(f"ccnn_{name}(" in function for function in functions):
            head = f"static inline ccnn_real ccnn_{name}(ccnn_real a, ccnn_real b)"
            parts.append(f"{head}\n{{\n    return a {sign} b ? a : b;\n}}")
    return "\n\n".join([*parts, *functions]) + "\n"


def _routine(routine: Routine, form: Form, dialect: Dialect, static: str) -> str:
    """What a user calls; returns the status."""
    sizes = form.sizes
    outputs = [f"ccnn_real {name}[]" for name in routine.returns]
    own = [name for name in form.variables(routine) if name not in routine.returns]
    lines = [f"ccnn_real {', '.join(f'{name}[{sizes[name]}]' for name in own)};"]
    if form.covariates:
        value = "more[j] = covariates == NULL ? (ccnn_real)NAN : covariates[j];"
        lines += ["ccnn_real more[CCNN_COVARIATES];", *dialect.loop("j", len(form.covariates), [value])]
    else:
        lines.append("(void)covariates;")

    def call(name: str) -> str:
        program = form.programs[name]
        names = ["more" if i == "covariates" else i for i in program.inputs]
        return f"ccnn_{name}({', '.join([*names, *program.outputs])});"

    lines += routine_lines(routine, form, dialect, call, {})
    arguments = ", ".join(["const ccnn_real given[]", "const ccnn_real covariates[]", *outputs])
    head = f"{static}int ccnn_{routine.name}({arguments})"
    return "\n".join([head, "{", *(f"    {line}" for line in lines), "    return (int)status[0];", "}"])


def _selftest(form: Form, golden: Golden) -> str:
    dialect, outputs = c_dialect(form.dtype), golden.outputs
    names = {"joints": golden.joints, "covariates": golden.covariates} | {
        k: v for k, v in outputs.items() if "status" not in k
    }
    tables = [c_constants(f"golden_{k}", v, dialect) for k, v in names.items() if v.size]
    for k in ("status", "ideal_status"):
        rows = _whole(outputs[k])
        tables.append(f"static const char golden_{k}[{len(outputs[k])}] = {{\n    {rows}\n}};")
    tables.append(c_constants("tolerance", golden.tolerance, dialect))
    return filled(
        "selftest.c.jinja",
        tables=tables,
        covariates=form.covariates,
        sd=form.sd,
        count=len(golden.joints),
        relative=dialect.literal(golden.relative),
        rounding=dialect.literal(4 * float(np.finfo(form.dtype).eps)),
        zero=dialect.literal(0.0),
        one=dialect.literal(1.0),
        damped=dialect.literal(DAMPED_TOLERANCE),
        # Of C's functions: fabsf is that of single precision.
        s="f" if form.dtype == "float32" else "",
    )


def _whole(values: Array) -> str:
    """Whole numbers in lines."""
    return ",\n    ".join(", ".join(map(str, values[k : k + 30].tolist())) for k in range(0, len(values), 30))
