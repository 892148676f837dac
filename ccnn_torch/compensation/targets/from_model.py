"""The form of a compensator: its programs, traced for one row."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.fx.experimental.proxy_tensor import make_fx

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.contraction import Steepness, iterations_needed
from ccnn_torch.compensation.secant import Step
from ccnn_torch.compensation.targets.form import Form, MachinePrograms, Program
from ccnn_torch.compensation.targets.from_graph import program_of

# Share of the limit to which single precision is right.
SINGLE_TOLERANCE = 1e-5
# As in the check of every other model file: what is left of command + deviation = joints, as a share of the limit.
_SLACK = {"float64": 1e-6, "float32": SINGLE_TOLERANCE}
# From here a number counts as infinite where single precision has no 1e300.
_HUGE_SINGLE = 3e38


class _Clean(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Finite joints and covariates, and how many were not."""
        return self.compensator._inputs(joints, covariates)


class _Step(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """δ, excess and standard deviation at finite commanded joints."""
        covariates = joints[..., :0] if covariates is None else covariates
        strange = torch.zeros_like(joints[..., :1])
        own = self.compensator
        learned = own._learned(joints, covariates, strange)
        found = learned.value if own.machine is not None else own._deviation(joints, covariates, learned)
        return found, learned.excess, own.sd_of(learned.weight, learned.features)


class _Aim(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor) -> Tensor:
        """The machine's aim for ideal joints."""
        assert self.compensator.machine is not None
        return self.compensator.machine.aim(joints)


class _Towards(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(
        self, joints: Tensor, correction: Tensor, aim: Tensor, covariates: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The machine's next correction at a command, the excess there, and doubt."""
        covariates = joints[..., :0] if covariates is None else covariates
        strange = torch.zeros_like(joints[..., :1])
        learned, found, doubt = self.compensator.step(joints, covariates, strange, correction, aim)
        return found, learned.excess, doubt


class _AimBack(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The machine's aim for the way back of a command, and the excess there."""
        covariates = joints[..., :0] if covariates is None else covariates
        learned, aim = self.compensator.aim_back(joints, covariates, torch.zeros_like(joints[..., :1]))
        return aim, learned.excess


class _Back(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, joints: Tensor, correction: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
        """Command less ideal joints to try next, and doubt."""
        return self.compensator.step_back(joints, correction, aim)


class _Next(nn.Module):
    def __init__(self, compensator: Compensator) -> None:
        super().__init__()
        self.compensator = compensator

    def forward(self, found: Tensor, correction: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
        """The next correction, and all steps before but the oldest with this one: so many numbers as before."""
        pairs = steps.reshape(*found.shape[:-1], -1, 2, found.shape[-1]).unbind(-3)
        before = [Step(*pair.unbind(-2)) for pair in pairs]
        correction, after = self.compensator.next_correction(found, correction, before)
        return correction, torch.cat([number for step in after[1:] for number in step], -1)


def form_of(compensator: Compensator, dtype: str = "float64", sd: bool = False) -> Form:
    """The form of a fitted compensator.

    Args:
        dtype: `float64` or `float32`, in which the targets compute.

    Raises:
        MethodFailedError: the model has an operation that no form has.
    """
    compensator = copy.deepcopy(compensator)
    iterations = compensator.iterations
    if dtype == "float32":
        compensator.domain.huge.clamp_(max=_HUGE_SINGLE)
        if not compensator.secant:
            iterations = iterations_needed(Steepness(compensator.lipschitz, 1.0), SINGLE_TOLERANCE / 10)
    n = len(compensator.joints)
    point = compensator.domain.centre.unsqueeze(0)
    example = (point[:, :n].clone(), point[:, n:].clone())[: 2 if compensator.covariates else 1]
    names = ("joints", "covariates")[: len(example)]

    kept: list[list[str | None]] = [["deviation", "excess", None], *([[None, "excess", "sd"]] if sd else [])]
    secant = None
    if compensator.secant:
        # A tensor of its own for each: the tracer takes equal tensors for one input.
        blank = [torch.zeros(1, k * n, dtype=torch.float64) for k in (1, 1, 2 * max(1, iterations - 1))]
        given = ("found", "correction", "steps")
        secant = traced_program(_Next(compensator), (*blank,), "secant", given, [*given[1:]])
    (clean,) = _programs(_Clean(compensator), example, "clean", names, [["joints", "covariates", "strange"]])
    deviation, *spread = _programs(_Step(compensator), example, "deviation", names, kept)
    machine = _machine_programs(compensator, example, names)
    for one in spread:
        one.name = "spread"
    limit = compensator.most.numpy()
    return Form(
        [c.header for c in compensator.joints],
        [c.header for c in compensator.covariates],
        iterations,
        limit,
        _SLACK[dtype] * np.minimum(limit, 1.0),
        compensator.fallback_sd.numpy(),
        dtype,
        clean,
        deviation,
        secant,
        spread[0] if spread else None,
        machine,
    )


def _machine_programs(
    compensator: Compensator, example: tuple[Tensor, ...], names: Sequence[str]
) -> MachinePrograms | None:
    """Those of a machine; None without one."""
    if compensator.machine is None:
        return None
    joints, more = example[0], [v.clone() for v in example[1:]]
    correction, aim = torch.zeros_like(joints), compensator.machine.aim(joints)
    found = ["correction", "excess", "doubt"]
    at = ("joints", "correction", "aim")
    return MachinePrograms(
        traced_program(_Aim(compensator), (joints,), "aim", ("joints",), ["aim"]),
        traced_program(_Towards(compensator), (joints, correction, aim, *more), "towards", (*at, *names[1:]), [*found]),
        traced_program(_AimBack(compensator), example, "aim_back", names, ["aim", "excess"]),
        traced_program(_Back(compensator), (joints, correction, aim), "back", at, ["correction", "doubt"]),
    )


def traced_program(
    module: nn.Module, example: tuple[Tensor, ...], name: str, inputs: Sequence[str], outputs: list[str | None]
) -> Program:
    """A module as a program, traced for one row.

    Raises:
        MethodFailedError: it has an operation that no form has.
    """
    return _programs(module, example, name, inputs, [outputs])[0]


def _programs(
    module: nn.Module,
    example: tuple[Tensor, ...],
    name: str,
    inputs: Sequence[str],
    outputs: list[list[str | None]],
) -> list[Program]:
    # By running it: operations on one row, those that mutate as ones that do not.
    with torch.no_grad():
        traced = make_fx(torch.func.functionalize(lambda *given: module(*given)), tracing_mode="real")(*example)
    return [program_of(traced, name, inputs, some) for some in outputs]
