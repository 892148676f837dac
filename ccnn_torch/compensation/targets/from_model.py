"""The form of a compensator: its functions as programs, traced for one row, and the routines that call them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.contraction import Steepness, iterations_needed
from ccnn_torch.compensation.routines import ControllerFunctions, Routine, routines_of
from ccnn_torch.compensation.targets.form import Form, Program
from ccnn_torch.compensation.targets.from_graph import program_of

# Share of the limit to which single precision is right.
SINGLE_TOLERANCE = 1e-5
# As in the check of every other model file: what is left of command + deviation = joints, as a share of the limit.
_SLACK = {"float64": 1e-6, "float32": SINGLE_TOLERANCE}
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
    routines = routines_of(own)
    if sd:
        about = "Standard deviation of a newly measured deviation at a command, model and noise."
        routines.append(Routine("deviation_sd", about, "command", ("sd",), ("clean", "spread")))
    functions = ControllerFunctions(own, _SLACK[dtype], dtype)
    names = dict.fromkeys(name for routine in routines for name, _ in routine.calls)
    way = "the fixed point" if own.machine is None else "Gauss and Newton's method"
    return Form(
        [c.header for c in own.joints],
        [c.header for c in own.covariates],
        own.iterations,
        "Broyden's method" if own.secant else way,
        own.most.numpy(),
        own.fallback_sd.numpy(),
        dtype,
        {name: _program(functions, name) for name in names},
        {routine.name: routine for routine in routines},
    )


def _program(functions: ControllerFunctions, name: str) -> Program:
    """One of the functions; variables without numbers are left out, as covariates where there are none."""
    every = functions.inputs_of(name)
    # A tensor of its own for each: the tracer takes equal tensors for one input.
    examples = {i: functions.examples[i].clone() for i in every if functions.examples[i].numel()}
    nothing = torch.zeros(1, 0, dtype=torch.float64)

    def called(*values: Tensor) -> Sequence[Tensor]:
        given = dict(zip(examples, values, strict=True))
        found: Sequence[Tensor] = getattr(functions, name)(*(given.get(i, nothing) for i in every))
        return found

    return traced_program(called, [*examples.values()], name, [*examples], functions.outputs[name].split())


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
    return program_of(traced, name, inputs, outputs)
