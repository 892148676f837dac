"""The command and the way back as routines: functions of torch on named variables, and the statements that call them.

Every export is made of these: C99 and Structured Text function by function with the statements around them, ONNX as
one graph without loops.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator, status_of
from ccnn_torch.compensation.machine import ASTRAY
from ccnn_torch.compensation.secant import Step


class Copy(NamedTuple):
    """A variable gets the numbers of another one, or zeros where `source` is ""."""

    target: str
    source: str = ""


class Repeat(NamedTuple):
    """Statements, so many times."""

    times: int
    statements: tuple[Any, ...]


# The name of a function that is called, a `Copy`, or a `Repeat`.
Statement = Any


@dataclass(frozen=True)
class Routine:
    """What a controller calls: statements on variables, each an array, of which `given` and `covariates` are given.

    Attributes:
        name: of the routine.
        about: what it gives, for a reader.
        given: what the joints that are given are called outside.
        returns: variables that it gives beside `status`.
        statements: in order.
    """

    name: str
    about: str
    given: str
    returns: tuple[str, ...]
    statements: tuple[Statement, ...]

    @property
    def calls(self) -> list[tuple[str, int]]:
        """Functions, and how often each is called."""
        return [*_calls(self.statements, 1)]


def _calls(statements: Sequence[Statement], times: int) -> Iterator[tuple[str, int]]:
    for statement in statements:
        if isinstance(statement, str):
            yield statement, times
        elif isinstance(statement, Repeat):
            yield from _calls(statement.statements, times * statement.times)


def routines_of(own: Compensator, kept: Sequence[Copy] = ()) -> list[Routine]:
    """Command and way back.

    Args:
        kept: what the end of a machine's command needs of its first step, beside `first` and `near`.
    """
    following: tuple[Statement, ...] = (Copy("correction", "found"),)
    start: tuple[Statement, ...] = ("clean", Copy("correction"))
    if own.secant:
        following, start = ("following", Copy("correction", "next"), Copy("steps", "done")), (*start, Copy("steps"))
    again = Repeat(own.iterations, (*following, "step"))
    command: tuple[Statement, ...] = ("step", again, "finish")
    back: tuple[Statement, ...] = ("step", "finish_back")
    if own.machine is not None:
        # The first step is taken where the last one goes astray.
        command = "aim", "step", Copy("first", "found"), Copy("near", "excess"), *kept, again, "choose"
        again = Repeat(own.iterations, (Copy("correction", "found"), "back"))
        back = "aim_back", "back", Copy("first", "found"), again, "choose_back"
    about = "Command for ideal joints: command + deviation = joints."
    about_back = "The way back: ideal joints of a command, or of joints fed back."
    return [
        Routine("compensate", about, "joints", ("command", "deviation"), (*start, *command)),
        Routine("ideal", about_back, "command", ("joints",), (*start[:2], *back)),
    ]


class Functions:
    """Functions of a compensator, with the variables that they take as parameters.

    Variables: `given`, `covariates` as they are given; `q`, `x` the same made finite, and `strange`, how many were not;
    `aim` of a machine; `correction` tried, `found` to try next, `excess` above 0 outside the domain, and `doubt` above
    0 where `correction` is not the exact one; `first`, `near`: `found` and `excess` of the first step; `steps` of
    Broyden's method, with `next` and `done` to follow.

    Attributes:
        outputs: variables that each function gives.
        examples: of every variable, `rows x …`.
    """

    outputs: ClassVar[dict[str, str]] = {"aim": "aim", "following": "next done", "back": "found doubt"}

    def __init__(self, own: Compensator, rows: int = 1) -> None:
        self.own, self.joints = own, len(own.joints)
        point = own.domain.centre.repeat(rows, 1)
        q, x = point[:, : self.joints].contiguous(), point[:, self.joints :].contiguous()
        self.examples = {"inputs": point, "given": q, "covariates": x, "q": q, "x": x}
        self.examples |= dict.fromkeys(("strange", "near", "excess", "doubt"), torch.zeros_like(point[:, :1]))
        self.examples |= dict.fromkeys(("first", "correction", "found"), torch.zeros_like(q))
        self.examples["aim"] = q[:, :0] if own.machine is None else own.machine.aim(q)
        self.room = max(1, own.iterations - 1)

    def inputs_of(self, name: str) -> list[str]:
        """Variables that a function takes."""
        return [*signature(getattr(self, name)).parameters]

    def aim(self, q: Tensor) -> Sequence[Tensor]:
        assert self.own.machine is not None
        return (self.own.machine.aim(q),)

    def following(self, found: Tensor, correction: Tensor, steps: Tensor) -> Sequence[Tensor]:
        """The next correction, and the last steps with this one, of which there is room for so many."""
        n = self.joints
        parts = [steps[..., k : k + n] for k in range(0, steps.shape[-1], n)]
        before = [Step(*pair) for pair in zip(parts[::2], parts[1::2], strict=True)]
        following, after = self.own.next_correction(found, correction, before)
        return following, torch.cat([number for step in after[-self.room :] for number in step], -1)

    def back(self, q: Tensor, correction: Tensor, aim: Tensor) -> Sequence[Tensor]:
        return self.own.step_back(q - correction, correction, aim)


class ControllerFunctions(Functions):
    """Those of a controller, which has no check of what a model promises around it.

    Without a machine joints are commanded as they are where command + deviation is not the joints, or the deviation
    above its limit.
    """

    outputs: ClassVar[dict[str, str]] = Functions.outputs | {
        "clean": "q x strange",
        "step": "found excess doubt",
        "aim_back": "aim excess",
        "finish": "command deviation status",
        "choose": "command deviation status",
        "finish_back": "joints status",
        "choose_back": "joints status",
        "spread": "sd status",
    }

    def __init__(self, own: Compensator, slack: float, dtype: str) -> None:
        """slack: how far command + deviation may be from the joints, as a share of the limit [1]."""
        super().__init__(own)
        self.slack = slack * torch.clamp_max(own.most, 1.0)
        # The rounding of a joint.
        self.eps = 8 * float(np.finfo(dtype).eps)
        self.examples["steps"] = torch.zeros(1, 2 * self.joints * self.room, dtype=torch.float64)

    def clean(self, given: Tensor, covariates: Tensor) -> Sequence[Tensor]:
        return self.own._inputs(given, covariates)

    def step(self, q: Tensor, correction: Tensor, aim: Tensor, x: Tensor) -> Sequence[Tensor]:
        blank = torch.zeros_like(q[..., :1])
        learned, found, doubt = self.own.step(q - correction, x, blank, correction, aim)
        return found, learned.excess, doubt

    def aim_back(self, q: Tensor, x: Tensor) -> Sequence[Tensor]:
        learned, aim = self.own.aim_back(q, x, torch.zeros_like(q[..., :1]))
        return aim, learned.excess

    def spread(self, q: Tensor, x: Tensor, strange: Tensor) -> Sequence[Tensor]:
        learned = self.own._learned(q, x, torch.zeros_like(strange))
        sd = self.own.sd_of(learned.weight, learned.features)
        good = torch.logical_and(sd >= 0, sd < torch.inf).all(-1, keepdim=True) & (strange <= 0)
        return torch.where(good, sd, self.own.fallback_sd), status_of(strange, good & (learned.excess <= 0))

    def finish(self, q: Tensor, strange: Tensor, correction: Tensor, found: Tensor, excess: Tensor) -> Sequence[Tensor]:
        command = q - correction
        rounding = self.slack + self.eps * (q.abs() + found.abs())
        # Written so that what is no number is not good.
        right = ((command + found - q).abs() <= rounding).all(-1, keepdim=True)
        good = right & self.own.is_allowed(found) & (strange <= 0)
        state = status_of(strange, good & (excess <= 0))
        return torch.where(good, command, q), torch.where(good, found, 0.0), state

    def finish_back(self, q: Tensor, strange: Tensor, found: Tensor, excess: Tensor) -> Sequence[Tensor]:
        good = self.own.is_allowed(found) & (strange <= 0)
        return torch.where(good, q + found, q), status_of(strange, good & (excess <= 0))

    def choose(
        self,
        q: Tensor,
        strange: Tensor,
        first: Tensor,
        near: Tensor,
        correction: Tensor,
        excess: Tensor,
        doubt: Tensor,
    ) -> Sequence[Tensor]:
        good = self.own.is_allowed(correction) & (doubt <= ASTRAY)
        deviation = torch.where(strange <= 0, torch.where(good, correction, first), 0.0)
        return q - deviation, deviation, status_of(strange, torch.where(good, excess, near) <= 0, doubt)

    def choose_back(
        self, q: Tensor, strange: Tensor, first: Tensor, correction: Tensor, excess: Tensor, doubt: Tensor
    ) -> Sequence[Tensor]:
        ideal, _, state = self.choose(q, strange, first, excess, correction, excess, doubt)
        return ideal, state
