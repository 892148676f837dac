"""The form of a compensator: its programs, traced for one row, and the routines that call them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from ccnn_torch.compensation.compensator import DAMPED, EXACT, NOT_FINITE, OUTSIDE, Compensator
from ccnn_torch.compensation.contraction import Steepness, iterations_needed
from ccnn_torch.compensation.machine.machine import ASTRAY
from ccnn_torch.compensation.secant import Step
from ccnn_torch.compensation.targets.form import Call, Copy, Form, Program, Repeat, Routine
from ccnn_torch.compensation.targets.from_graph import program_of

# Share of the limit to which single precision is right.
SINGLE_TOLERANCE = 1e-5
# As in the check of every other model file: what is left of command + deviation = joints, as a share of the limit.
_SLACK = {"float64": 1e-6, "float32": SINGLE_TOLERANCE}
# Of a limit, for its rounding.
_EDGE = 1e-9
# From here a number counts as infinite where single precision has no 1e300.
_HUGE_SINGLE = 3e38


def form_of(compensator: Compensator, dtype: str = "float64", sd: bool = False) -> Form:
    """The form of a fitted compensator.

    Args:
        dtype: `float64` or `float32`, in which the targets compute.
        sd: with the routine for the standard deviation.

    Raises:
        MethodFailedError: the model has an operation that no form has.
    """
    own = copy.deepcopy(compensator)
    if dtype == "float32":
        own.domain.huge.clamp_(max=_HUGE_SINGLE)
        if not own.secant:
            own.iterations = iterations_needed(Steepness(own.lipschitz, 1.0), SINGLE_TOLERANCE / 10)
    programs = _programs(own, dtype, sd)
    routines = {"compensate": _compensate(own, programs), "ideal": _ideal(own, programs)}
    if sd:
        calls = (_clean(own, programs, "command"), _call(programs["spread"], ("sd", "status")))
        about = "Standard deviation of a newly measured deviation at a command, model and noise."
        routines["deviation_sd"] = Routine("deviation_sd", about, "command", ("sd",), calls)
    way = "the fixed point" if own.machine is None else "Gauss and Newton's method"
    return Form(
        [c.header for c in own.joints],
        [c.header for c in own.covariates],
        own.iterations,
        "Broyden's method" if own.secant else way,
        own.most.numpy(),
        own.fallback_sd.numpy(),
        dtype,
        programs,
        routines,
    )


def _programs(own: Compensator, dtype: str, sd: bool) -> dict[str, Program]:
    """Those of a compensator by name; inputs and outputs are the variables of the routines."""
    n, machine = len(own.joints), own.machine
    point = own.domain.centre.unsqueeze(0)
    examples = {name: torch.zeros(1, 1, dtype=torch.float64) for name in ("strange", "near", "excess", "doubt")}
    examples |= {name: torch.zeros(1, n, dtype=torch.float64) for name in ("first", "correction", "found")}
    examples |= {"joints": point[:, :n].clone(), "covariates": point[:, n:].clone()}
    examples["steps"] = torch.zeros(1, 2 * n * max(1, own.iterations - 1), dtype=torch.float64)
    if machine is not None:
        examples["aim"] = machine.aim(examples["joints"])
    found: dict[str, Program] = {}

    def add(name: str, function: Callable[..., Sequence[Tensor]], inputs: str, outputs: str) -> None:
        # No model has all of them.
        names = [i for i in inputs.split() if examples.get(i, point[0, :0]).numel()]

        def called(*values: Tensor) -> Sequence[Tensor]:
            given = dict(zip(names, values, strict=True))
            return function(*(given.get(i, values[0][..., :0]) for i in inputs.split()))

        # A tensor of its own for each: the tracer takes equal tensors for one input.
        found[name] = traced_program(called, [examples[i].clone() for i in names], name, names, outputs.split())

    def clean(joints: Tensor, covariates: Tensor) -> Sequence[Tensor]:
        return own._inputs(joints, covariates)

    def step(joints: Tensor, correction: Tensor, aim: Tensor, covariates: Tensor) -> Sequence[Tensor]:
        command = joints - correction
        learned, following, doubt = own.step(command, covariates, torch.zeros_like(command[..., :1]), correction, aim)
        return following, learned.excess, doubt

    def following(found: Tensor, correction: Tensor, steps: Tensor) -> Sequence[Tensor]:
        """The next correction, and all steps before but the oldest with this one: so many numbers as before."""
        pairs = steps.reshape(*found.shape[:-1], -1, 2, n).unbind(-3)
        correction, after = own.next_correction(found, correction, [Step(*pair.unbind(-2)) for pair in pairs])
        return correction, torch.cat([number for step in after[1:] for number in step], -1)

    def aim_back(joints: Tensor, covariates: Tensor) -> Sequence[Tensor]:
        learned, aim = own.aim_back(joints, covariates, torch.zeros_like(joints[..., :1]))
        return aim, learned.excess

    def back(joints: Tensor, correction: Tensor, aim: Tensor) -> Sequence[Tensor]:
        return own.step_back(joints - correction, correction, aim)

    def spread(joints: Tensor, covariates: Tensor, strange: Tensor) -> Sequence[Tensor]:
        learned = own._learned(joints, covariates, torch.zeros_like(strange))
        sd = own.sd_of(learned.weight, learned.features)
        # Written so that what is no number is not good.
        good = _every(torch.logical_and(sd >= 0, sd < torch.inf)) & (strange <= 0)
        return torch.where(good, sd, own.fallback_sd), _status(strange, good & (learned.excess <= 0))

    add("clean", clean, "joints covariates", "joints covariates strange" if own.covariates else "joints - strange")
    add("step", step, "joints correction aim covariates", "found excess doubt")
    if own.secant:
        add("secant", following, "found correction steps", "correction steps")
    if machine is None:
        finish = _Trusted(own, _SLACK[dtype] * torch.clamp_max(own.most, 1.0), 8 * float(np.finfo(dtype).eps))
        add("finish", finish.command, "joints strange correction found excess", "command deviation status")
        add("finish_back", finish.back, "joints strange found excess", "joints status")
    else:
        add("aim", lambda joints: (machine.aim(joints),), "joints", "aim")
        add("aim_back", aim_back, "joints covariates", "aim excess")
        add("back", back, "joints correction aim", "found doubt")
        chosen = _Chosen(own.most)
        inputs = "joints strange first near correction excess doubt"
        add("finish", chosen.command, inputs, "command deviation status")
        add("finish_back", chosen.back, "joints strange first correction excess doubt", "joints status")
    if sd:
        add("spread", spread, "joints covariates strange", "sd status")
    return found


def _every(good: Tensor) -> Tensor:
    return good.all(-1, keepdim=True)


def _status(strange: Tensor, exact: Tensor, known: Tensor | None = None) -> Tensor:
    """known: whether it is not damped, `... x 1`."""
    found = torch.where(exact, float(EXACT), float(OUTSIDE))
    if known is not None:
        found = torch.where(known, found, float(DAMPED))
    return torch.where(strange > 0, float(NOT_FINITE), found)


class _Trusted:
    """The end of either way without a machine: joints as they are where the model breaks what it promises."""

    def __init__(self, own: Compensator, slack: Tensor, eps: float) -> None:
        """slack: how far command + deviation may be from the joints, `n` [SI]; eps: and the rounding of a joint [1]."""
        self.most, self.slack, self.eps = own.most * (1 + _EDGE), slack, eps

    def command(
        self, joints: Tensor, strange: Tensor, correction: Tensor, found: Tensor, excess: Tensor
    ) -> Sequence[Tensor]:
        """Command, deviation and status."""
        command = joints - correction
        allowed = self.slack + self.eps * (joints.abs() + found.abs())
        right = torch.logical_and((command + found - joints).abs() <= allowed, found.abs() <= self.most)
        good = _every(right) & (strange <= 0)
        state = _status(strange, good & (excess <= 0))
        return torch.where(good, command, joints), torch.where(good, found, 0.0), state

    def back(self, joints: Tensor, strange: Tensor, found: Tensor, excess: Tensor) -> Sequence[Tensor]:
        """Ideal joints and status."""
        good = _every(found.abs() <= self.most) & (strange <= 0)
        return torch.where(good, joints + found, joints), _status(strange, good & (excess <= 0))


class _Chosen:
    """The end of either way of a machine: the first step where the last one went astray."""

    def __init__(self, most: Tensor) -> None:
        self.most = most * (1 + _EDGE)

    def command(
        self,
        joints: Tensor,
        strange: Tensor,
        first: Tensor,
        near: Tensor,
        correction: Tensor,
        excess: Tensor,
        doubt: Tensor,
    ) -> Sequence[Tensor]:
        """Command, deviation and status; near: excess of the first step."""
        # Written so that what is no number is not good.
        good = _every(correction.abs() <= self.most) & (doubt <= ASTRAY)
        deviation = torch.where(strange <= 0, torch.where(good, correction, first), 0.0)
        return joints - deviation, deviation, _status(strange, torch.where(good, excess, near) <= 0, doubt <= 0)

    def back(
        self, joints: Tensor, strange: Tensor, first: Tensor, correction: Tensor, excess: Tensor, doubt: Tensor
    ) -> Sequence[Tensor]:
        """Ideal joints and status."""
        ideal, _, state = self.command(joints, strange, first, excess, correction, excess, doubt)
        return ideal, state


def _call(program: Program, outputs: Sequence[str] = ()) -> Call:
    """A program with variables of the names of its own inputs and outputs; joints and covariates are finite ones."""
    finite = {"joints": "q", "covariates": "x"}
    named = outputs or [name for name, ids in program.outputs.items() if ids]
    return Call(program, tuple(finite.get(name, name) for name in program.inputs), tuple(named))


def _clean(own: Compensator, programs: dict[str, Program], given: str) -> Call:
    names = [("covariates", "x")] if own.covariates else []
    inputs, outputs = zip((given, "q"), *names, strict=True)
    return Call(programs["clean"], inputs, (*outputs, "strange"))


def _compensate(own: Compensator, programs: dict[str, Program]) -> Routine:
    n, kept = len(own.joints), len(programs["secant"].outputs["steps"]) if own.secant else 0
    step = _call(programs["step"])
    statements = [_clean(own, programs, "joints"), Copy("correction", "", n)]
    if own.machine is not None:
        statements.append(_call(programs["aim"]))
    statements.append(step)
    if own.machine is not None:
        statements += [Copy("first", "found", n), Copy("near", "excess", 1)]
    following = [Copy("correction", "found", n)]
    if own.secant:
        statements.append(Copy("steps", "", kept))
        following = [_call(programs["secant"], ("next", "done"))]
        following += [Copy("correction", "next", n), Copy("steps", "done", kept)]
    repeated = Repeat(own.iterations, (*following, step))
    returns = ("command", "deviation")
    statements += [repeated, _call(programs["finish"], (*returns, "status"))]
    about = "Command for ideal joints: command + deviation = joints."
    return Routine("compensate", about, "joints", returns, tuple(statements))


def _ideal(own: Compensator, programs: dict[str, Program]) -> Routine:
    n = len(own.joints)
    statements = [_clean(own, programs, "command"), Copy("correction", "", n)]
    if own.machine is None:
        statements.append(_call(programs["step"]))
    else:
        back = _call(programs["back"])
        repeated = Repeat(own.iterations, (Copy("correction", "found", n), back))
        statements += [_call(programs["aim_back"]), back, Copy("first", "found", n), repeated]
    statements.append(_call(programs["finish_back"], ("joints", "status")))
    about = "The way back: ideal joints of a command, or of joints fed back."
    return Routine("ideal", about, "command", ("joints",), tuple(statements))


def traced_program(
    function: Callable[..., Tensor | Sequence[Tensor]],
    example: Sequence[Tensor],
    name: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Program:
    """A function as a program, traced for one row.

    Raises:
        MethodFailedError: it has an operation that no form has.
    """
    # By running it: operations on one row, those that mutate as ones that do not.
    with torch.no_grad():
        traced = make_fx(torch.func.functionalize(lambda *given: function(*given)), tracing_mode="real")(*example)
    return program_of(traced, name, inputs, [None if name == "-" else name for name in outputs])
