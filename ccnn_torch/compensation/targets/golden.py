"""Whether an export gives the eager model's numbers: golden vectors, a form run in numpy, how far off it may be."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import TOLERANCE, Compensator
from ccnn_torch.compensation.fit import SINGLE_TOLERANCE
from ccnn_torch.compensation.outputs import DAMPED
from ccnn_torch.compensation.routines import execute
from ccnn_torch.compensation.targets.form import OPERATIONS, Array, Expression, Form, Leaf, Let, Program
from ccnn_torch.errors import MethodFailedError

# Near a singular pose rounding grows: what is allowed there, in units of what is allowed elsewhere.
DAMPED_TOLERANCE = 1e3
# Outputs of the way back, as a form's user calls them.
_BACK = {"joints": "ideal", "status": "ideal_status"}
_RANDOM = 1000
# Corners of the domain are as many as 2 to the power of its inputs; of more inputs than these the middle is taken.
_CORNERS = 6
# How far beside an edge a vector is, in units of the half range: rounding must not decide on which side.
_BESIDE = {"float64": 1e-9, "float32": 1e-3}


@dataclass(frozen=True)
class Golden:
    """Rows of inputs and outputs, of a form as `run_form` gives them.

    Attributes:
        joints: given, `s x n` [SI], with NaN and infinities.
        covariates: `s x m` [SI].
        outputs: of the eager model by name, among them `status` and `ideal_status`.
        tolerance: of deviation and of ideal - joints, `n` [SI].
        relative: of the standard deviation [1].
        hard: why single precision may not hold the model.
    """

    joints: Array
    covariates: Array
    outputs: dict[str, Array]
    tolerance: Array
    relative: float
    hard: str = ""

    def errors(self, found: dict[str, Array], names: Collection[str] = ()) -> dict[str, float]:
        """Largest difference of each output in the first rows, in units of what is allowed: above 1 is wrong.

        Args:
            names: of outputs; all when empty.
        """
        rows = len(found["command"])
        worst = {}
        for name in names or self.outputs:
            wanted = self.outputs[name][:rows]
            if wanted.dtype.kind in "bi":
                worst[name] = np.inf if (found[name] != wanted).any() else 0.0
                continue
            size = np.abs(wanted)
            own = {"deviation": 0.0, "sd": self.relative * size, "deviation_sd": self.relative * size}
            rounding = own[name] if name in own else 2 * np.spacing(size.astype(found["command"].dtype))
            state = self.outputs["ideal_status" if name == "ideal" else "status"][:rows]
            times = np.where(state == DAMPED, DAMPED_TOLERANCE, 1.0)[:, None]
            # A number that is none is wrong; a joint without deviations has no tolerance.
            share = np.abs(found[name].astype(float) - wanted) / (times * self.tolerance + rounding + 1e-300)
            worst[name] = float(np.nan_to_num(share, nan=np.inf).max())
        return worst


def probe_points(compensator: Compensator, count: int = 256) -> tuple[Tensor, Tensor | None]:
    """Points to compare exports at, `s x n` and `s x m`: the domain, its transition, far outside, not finite."""
    generator = torch.Generator().manual_seed(1)
    domain = compensator.domain
    draw = 2 * torch.rand(count, len(domain.centre), generator=generator, dtype=torch.float64) - 1
    reach = torch.linspace(0.2, 3, count, dtype=torch.float64).unsqueeze(-1)
    spread = domain.centre + domain.half_range * draw * reach
    extreme = [float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e300, -1e308, 1e3, -1e3, 0.0, 5e-324]
    rows = [domain.centre.expand(1, -1)]
    for value in extreme:
        rows.append(torch.full((1, len(domain.centre)), value, dtype=torch.float64))
        one = domain.centre.repeat(len(domain.centre), 1)
        one.fill_diagonal_(value)
        rows.append(one)
    points = torch.cat([spread, *rows])
    n = len(compensator.joints)
    return points[:, :n].contiguous(), points[:, n:].contiguous() if compensator.covariates else None


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

    def call(called: str, values: dict[str, Array]) -> dict[str, Array]:
        program = form.programs[called]
        return run_program(program, {key: values[key] for key in program.inputs}, form.dtype)

    def zeros(variable: str) -> Array:
        return np.zeros((len(joints), form.sizes[variable]), form.dtype)

    execute(routine.statements, values, call, zeros)
    return {key: values[key] for key in routine.returns} | {"status": values["status"][:, 0].astype(int)}


def golden_vectors(compensator: Compensator, form: Form) -> Golden:
    """A thousand at random, all edges of the domain, far outside, no numbers and infinities."""
    joints, covariates = probe_points(compensator, _RANDOM)
    given = joints if covariates is None else torch.cat([joints, covariates], -1)
    edges = _edges(compensator, _BESIDE[form.dtype])
    n = len(compensator.joints)
    with torch.no_grad():
        # The ideal joints whose command is at an edge, and the edges themselves.
        ideal = torch.cat([compensator.back(*_split(edges, n)), edges[:, n:]], -1)
        given = torch.cat([given, edges, ideal])
        if form.dtype == "float32":
            given = given.float().double()
        found = compensator.solve(*_split(given, n))
        sd = compensator.sd(*_split(given, n))
    names = ("command", "deviation", "ideal", "status", "ideal_status")
    outputs = {name: getattr(found, name).numpy() for name in names}
    if form.sd:
        outputs["sd"] = sd.numpy()
    share = SINGLE_TOLERANCE if form.dtype == "float32" else compensator.export_tolerance
    values = given.numpy()
    return Golden(values[:, :n], values[:, n:], outputs, share * form.limit, 10 * share, _hard(compensator))


def require_equal(form: Form, golden: Golden) -> dict[str, float]:
    """Run the form on the vectors; returns the largest differences in units of what is allowed.

    Raises:
        MethodFailedError: the form is not the model.
    """
    worst = golden.errors(run_form(form, golden.joints, golden.covariates if form.covariates else None))
    wrong = [name for name, share in worst.items() if not share <= 1]
    if wrong and form.dtype == "float32":
        raise MethodFailedError(
            f"single precision does not hold this model: its output '{wrong[0]}' is off by more than "
            f"{SINGLE_TOLERANCE:g} of the limit ({golden.hard}); export it in float64"
        )
    if wrong:
        raise MethodFailedError(
            f"the exported form's output '{wrong[0]}' is not the model's to {golden.tolerance[0] / form.limit[0]:.0e} "
            "of the limit; report the model and the versions of torch and numpy"
        )
    return worst


def _hard(compensator: Compensator) -> str:
    """Which part of a model single precision rounds by more than a small share of its limit, most likely."""
    step, limit = float(np.finfo("float32").eps), float(compensator.limit.max())
    if compensator.machine is not None:
        return f"it computes the machine's kinematics: 1 m is rounded to {step:.1g} m, and the limit is {limit:.1g}"
    if getattr(compensator.network, "export_tolerance", TOLERANCE) > TOLERANCE:
        return "its network is a sum of many terms, which cancel"
    return f"a joint of 1 m or rad is rounded to {step:.1g}, and the limit is {limit:.1g}"


def _split(rows: Tensor, n: int) -> tuple[Tensor, Tensor | None]:
    return rows[:, :n].contiguous(), rows[:, n:].contiguous() if rows.shape[-1] > n else None


def _edges(compensator: Compensator, beside: float) -> Tensor:
    """Points inside and outside of each face of both boxes, where the fading is half done and ends, and corners."""
    domain = compensator.domain
    d = len(domain.centre)
    # Faces: directions of unit length in units of the half range, and how far along them.
    length = domain.directions.square().sum(-1, keepdim=True)
    unit = domain.directions / length
    rows = []
    for sign in (-1.0, 1.0):
        at = domain.middle + sign * domain.radius
        for beyond in (-beside, beside, 0.5 * domain.width, domain.width):
            rows.append(unit * (at + sign * beyond).unsqueeze(-1))
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * min(d, _CORNERS))
    corners = torch.nn.functional.pad(corners.reshape(-1, min(d, _CORNERS)), (0, max(0, d - _CORNERS)))
    for share in (1 - beside, 1 + beside):
        rows.append((corners * domain.radius[:d] + domain.middle[:d]) * share)
    return domain.centre + domain.half_range * torch.cat(rows)
