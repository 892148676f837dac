"""The command and the way back: the formulas of a compensator on named variables, and the statements that call them.

Everything that commands is made of these: the eager model runs them, ONNX has them as one graph without loops, C99 and
Structured Text function by function with the statements around them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from inspect import signature
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.compensation.machine import ASTRAY, SETTLED
from ccnn_torch.compensation.outputs import DAMPED, EXACT, NOT_FINITE, OUTSIDE

if TYPE_CHECKING:
    from ccnn_torch.compensation.compensator import Compensator

# Steps of Broyden's method below it are rounding, from which nothing is learned: share of the limit.
_ROUNDING = 1e-10
# A slope of at most 1/2, as compensators have, keeps the denominator above this but for curvature.
_LEAST = 0.5


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
        return [(one, times) for one, times in _flat(self.statements, 1) if isinstance(one, str)]

    @property
    def read(self) -> set[str]:
        """Variables that are copied or given."""
        copied = {one.source for one, _ in _flat(self.statements, 1) if isinstance(one, Copy)}
        return {*self.returns, "status", *copied}


def _flat(statements: Sequence[Statement], times: int) -> Iterator[tuple[Statement, int]]:
    for statement in statements:
        if isinstance(statement, Repeat):
            yield from _flat(statement.statements, times * statement.times)
        else:
            yield statement, times


def execute(
    statements: Sequence[Statement],
    values: dict[str, Any],
    call: Callable[[str, dict[str, Any]], dict[str, Any]],
    zeros: Callable[[str], Any],
) -> dict[str, Any]:
    """Variables after statements; `values` has them before, and is changed.

    Args:
        call: (name of a function, variables) -> the variables that it gives.
        zeros: name of a variable -> its zeros.
    """
    for statement in statements:
        if isinstance(statement, str):
            values |= call(statement, values)
        elif isinstance(statement, Copy):
            values[statement.target] = values[statement.source] if statement.source else zeros(statement.target)
        else:
            for _ in range(statement.times):
                execute(statement.statements, values, call, zeros)
    return values


# What a machine falls back to where its last step went astray.
KEPT = (Copy("near_weight", "weight"), Copy("near_features", "features"))


def next_step(own: Compensator) -> tuple[Statement, ...]:
    """What takes the correction that a step found, and tries it."""
    if own.secant:
        return "following", Copy("correction", "next"), Copy("steps", "done"), "step"
    return Copy("correction", "found"), "step"


def routines_of(
    own: Compensator, kept: Sequence[Copy] = (), last: bool = True, ends: Sequence[str] = ()
) -> list[Routine]:
    """Command and way back.

    Args:
        kept: what the end of a machine's command needs of its first step, beside `first` and `near`.
        last: whether the model without a machine is evaluated once more, at the command itself.
        ends: functions that are called after the command.
    """
    start: tuple[Statement, ...] = ("clean", Copy("correction"))
    again = Repeat(own.iterations, next_step(own))
    but_one = Repeat(own.iterations - 1, next_step(own))
    # What was learned is nearer to its mean than to 0.
    command = Copy("correction", "start"), "step", but_one, *next_step(own)[: None if last else -1], "finish"
    back: tuple[Statement, ...] = ("step", "finish_back")
    if own.machine is not None:
        # The first step is taken where the last one goes astray.
        command = "aim", "step", Copy("first", "found"), Copy("near", "excess"), *kept, again, "choose"
        again = Repeat(own.iterations, (Copy("correction", "found"), "back"))
        back = "aim_back", "back", Copy("first", "found"), again, "choose_back"
    about = "Command for ideal joints: command + deviation = joints."
    about_back = "The way back: ideal joints of a command, or of joints fed back."
    blank = (Copy("steps"),) if own.secant else ()
    return [
        Routine("compensate", about, "joints", ("command", "deviation"), (*start, *blank, *command, *ends)),
        Routine("ideal", about_back, "command", ("joints",), (*start, *back)),
    ]


def status_of(strange: Tensor, inside: Tensor, doubt: Tensor | None = None) -> Tensor:
    """Of a command, `... x 1`, int64.

    Args:
        strange: how many inputs were not finite, `... x 1`.
        inside: whether it is inside the domain and is what the model promises, `... x 1`.
        doubt: above 0 where it is not the exact one, `... x 1`.
    """
    found = torch.where(inside, EXACT, OUTSIDE)
    if doubt is not None:
        # Written so that what is no number is not exact.
        found = torch.where(doubt <= 0, found, DAMPED)
    return torch.where(strange < 1, found, NOT_FINITE)


class Learned(NamedTuple):
    """δ as it was learned, `... x n` [SI]; the guard's excess and weight, `... x 1` [1] each; and the network's
    features, `... x i` [1]."""

    value: Tensor
    excess: Tensor
    weight: Tensor
    features: Tensor


Variables = dict[str, Tensor]


class Functions:
    """The formulas of a compensator.

    Every function takes variables as parameters of their names and gives others. Variables: `inputs` as given; `ideal`
    and `x` joints and covariates made finite, `q` those joints as they are looked at; `strange`, how many inputs were
    not finite; `start`, the first correction; `aim` of a machine; `correction`
    tried, `found` to try next, `doubt` above 0 where `correction` is not the exact one; the guard's `excess`, above 0
    outside the domain, its `weight` and the network's `features`; `first` and `near…`, `found` and the others of the
    first step; `steps` of Broyden's method, with `next` and `done` to follow.
    """

    def __init__(self, own: Compensator, room: int = 0) -> None:
        """room: for so many of Broyden's steps; as many as the command takes when 0."""
        self.own, self.joints = own, len(own.joints)
        self.room = room or max(1, own.iterations - 1)
        # Without what is computed at the caged joints themselves, joints may be caged once, with room for a correction:
        # beyond the cage all deviations are the safe one.
        self.caged_once = own.machine is None

    def inputs_of(self, name: str) -> list[str]:
        """Variables that a function takes."""
        return _parameters(getattr(type(self), name))

    def call(self, name: str, values: Variables) -> Variables:
        """What a function gives."""
        found: Variables = getattr(self, name)(*(values[key] for key in self.inputs_of(name)))
        return found

    def start(self, inputs: Tensor) -> Variables:
        """Variables before a routine, for inputs `... x (n + m)` [SI], anything."""
        given, covariates = inputs[..., : self.joints], inputs[..., self.joints :]
        return {"inputs": inputs, "given": given, "covariates": covariates, "aim": inputs[..., :0]}

    def run(self, statements: Sequence[Statement], values: Variables) -> Variables:
        """Variables after statements; `values` has them before, and is changed."""
        blank = torch.zeros_like(values["given"])
        return execute(statements, values, self.call, lambda name: self.no_steps(blank) if name == "steps" else blank)

    def no_steps(self, blank: Tensor) -> Tensor:
        """`steps` before the first one; blank: joints, `... x n`."""
        return blank[..., :0]

    def clean(self, inputs: Tensor) -> Variables:
        n, own = self.joints, self.own
        finite, strange = own.domain.clean(inputs)
        at = self.in_reach(finite) if self.caged_once else finite
        found = {"ideal": finite[..., :n], "q": at[..., :n], "x": at[..., n:], "strange": strange}
        return found | {"start": own.safe.expand_as(found["q"])}

    def in_reach(self, inputs: Tensor) -> Tensor:
        """Inputs `... x d` [SI], kept where some correction leads to a place at which the guard has not ended."""
        own, domain = self.own, self.own.domain
        room = torch.cat([own.limit, own.limit.new_zeros(len(own.covariates))])
        return torch.minimum(torch.maximum(inputs, domain._cage_low - room), domain._cage_high + room)

    def excess(self, caged: Tensor) -> Tensor:
        """How far beyond the margin, `... x 1` [1]."""
        return self.own.domain.excess(caged)

    def faded(self, raw: Tensor, weight: Tensor) -> Tensor:
        """What a network gives `... x n` [SI], limited, and faded into the safe correction by its weight `... x 1`."""
        own = self.own
        # Two products instead of safe + weight · (limited - safe): each end is then exact.
        return own.limited(weight * own.limited(raw) + (1 - weight) * own.safe)

    def learned(self, command: Tensor, x: Tensor) -> Learned:
        """What was learned at a command; of rows that are not finite nothing is asked before the end."""
        own = self.own
        inputs = torch.cat([command, x], -1)
        caged = inputs if self.caged_once else own.domain.cage(inputs)
        features = own.scaling.features(caged)
        raw = own.scaling.restore(own.network(features))
        excess = self.excess(caged)
        fade = torch.relu(1 - excess)
        weight = fade * fade
        value = self.faded(raw, weight)
        return Learned(value, excess, weight, features)

    def step(self, q: Tensor, x: Tensor, correction: Tensor, aim: Tensor) -> Variables:
        own = self.own
        found, excess, weight, features = self.learned(q - correction, x)
        doubt = torch.zeros_like(weight)
        if own.machine is not None:
            wanted = own.machine.next_correction(found, own.held(x), q, correction, aim)
            bounded = own.machine.within(q, own.shortened(wanted), own.most)
            found, doubt = bounded, self._doubt(wanted, correction, aim)
        return {"found": found, "excess": excess, "weight": weight, "features": features, "doubt": doubt}

    def following(self, found: Tensor, correction: Tensor, steps: Tensor) -> Variables:
        """One step of Broyden's "good" method for d = δ(q - d), in sums, products, quotients and a maximum.

        The fixed point d ← δ(q - d) gains one factor of δ's slope with each evaluation of δ. This method learns that
        slope from the steps that were done, so that each gains more than the one before. It starts from the fixed point
        and needs no derivative; no matrix is kept, only the steps (C. T. Kelley, "Iterative methods for linear and
        nonlinear equations", SIAM 1995, section 7.3).

        Args:
            found: δ(q - correction), `... x n` [SI].
            correction: d, `... x n` [SI]; 0 at first.
            steps: those before, in order, `... x 2 n k`, each in units of the limits and with what gives another
                vector's share of it; blank ones (zeros) change nothing. There is room for so many of the last ones.
        """
        n, limit = self.joints, self.own.most
        before, ones = [steps[..., k : k + n] for k in range(0, steps.shape[-1], n)], torch.ones_like(limit)
        unit, ones = torch.where(limit > 0, limit, ones), ones.unsqueeze(-1)
        step = (found - correction) / unit
        # Steps shrink, so that the share is below 1 but for rounding, which must not grow.
        for dual, after in zip(before[1::2], before[2::2], strict=False):
            step = step + after * torch.clamp((dual * step) @ ones, -1.0, 1.0)
        if before:
            step = step / torch.clamp_min(1 - (before[-1] * step) @ ones, _LEAST)
        # A sum as a product: engines with a narrow operator list have no other reduction.
        dual = step / ((step * step) @ ones + _ROUNDING**2)
        done = torch.cat([*before, step, dual][-2 * self.room :], -1)
        return {"next": correction + unit * step, "done": done}

    def aim(self, q: Tensor) -> Variables:
        assert self.own.machine is not None
        return {"aim": self.own.machine.aim(q)}

    def aim_back(self, q: Tensor, x: Tensor) -> Variables:
        own = self.own
        assert own.machine is not None
        learned = self.learned(q, x)
        aim = own.machine.aim_back(q, learned.value, own.held(x))
        return {"aim": aim, "excess": learned.excess, "weight": learned.weight}

    def back(self, q: Tensor, correction: Tensor, aim: Tensor) -> Variables:
        own = self.own
        assert own.machine is not None
        wanted = own.machine.next_back(q, correction, aim)
        return {"found": own.shortened(wanted), "doubt": self._doubt(wanted, correction, aim)}

    def finish(
        self,
        ideal: Tensor,
        strange: Tensor,
        correction: Tensor,
        excess: Tensor,
        weight: Tensor,
        doubt: Tensor,
    ) -> Variables:
        inside = excess + strange <= 0
        correction, weight = (torch.where(strange < 1, v, 0.0) for v in (correction, weight))
        return {
            "command": ideal - correction,
            "deviation": correction,
            "inside_domain": inside.squeeze(-1),
            "guard": weight,
            "status": status_of(strange, inside, doubt).squeeze(-1),
        }

    def sure(self, strange: Tensor, weight: Tensor, features: Tensor) -> Variables:
        return {"deviation_sd": torch.where(strange < 1, self.own.sd_of(weight, features), self.own.fallback_sd)}

    def choose(
        self,
        ideal: Tensor,
        strange: Tensor,
        first: Tensor,
        near: Tensor,
        near_weight: Tensor,
        near_features: Tensor,
        correction: Tensor,
        excess: Tensor,
        weight: Tensor,
        features: Tensor,
        doubt: Tensor,
    ) -> Variables:
        good = self.own.is_allowed(correction) & (doubt <= ASTRAY)
        both = zip((correction, excess, weight, features), (first, near, near_weight, near_features), strict=True)
        taken, excess, weight, features = (torch.where(good, *pair) for pair in both)
        found = self.finish(ideal, strange, taken, excess, weight, doubt)
        return found | {"weight": weight, "features": features}

    def finish_back(
        self,
        ideal: Tensor,
        strange: Tensor,
        found: Tensor,
        excess: Tensor,
        weight: Tensor,
        doubt: Tensor,
    ) -> Variables:
        inside = excess + strange <= 0
        found, weight = (torch.where(strange < 1, v, 0.0) for v in (found, weight))
        return {
            "ideal": ideal + found,
            "back_deviation": found,
            "ideal_inside_domain": inside.squeeze(-1),
            "back_guard": weight,
            "ideal_status": status_of(strange, inside, doubt).squeeze(-1),
        }

    def choose_back(
        self,
        ideal: Tensor,
        strange: Tensor,
        first: Tensor,
        correction: Tensor,
        excess: Tensor,
        weight: Tensor,
        doubt: Tensor,
    ) -> Variables:
        good = self.own.is_allowed(correction) & (doubt <= ASTRAY)
        return self.finish_back(ideal, strange, -torch.where(good, correction, first), excess, weight, doubt)

    def _doubt(self, wanted: Tensor, correction: Tensor, aim: Tensor) -> Tensor:
        """Whether a correction is damped, at a bound or on its way, `... x 1`: above 0."""
        ones = torch.ones_like(self.own.most).unsqueeze(-1)
        return torch.relu((wanted - correction).abs() - SETTLED) @ ones + aim[..., -1:]


@cache
def _parameters(function: Callable[..., Variables]) -> list[str]:
    return [*signature(function).parameters][1:]


class ControllerFunctions(Functions):
    """Those of a controller, which has no check of what a model promises around it.

    Without a machine joints are commanded as they are where command + deviation is not the joints, or the deviation
    above its limit.
    """

    def __init__(self, own: Compensator, slack: float, dtype: str) -> None:
        """slack: how far command + deviation may be from the joints, as a share of the limit [1]."""
        super().__init__(own)
        self.caged_once = False
        self.slack = slack * torch.clamp_max(own.most, 1.0)
        # The rounding of a joint.
        self.eps = 8 * float(np.finfo(dtype).eps)

    def no_steps(self, blank: Tensor) -> Tensor:
        return blank.repeat(1, 2 * self.room)

    def clean(self, given: Tensor, covariates: Tensor) -> Variables:  # type: ignore[override]
        return super().clean(torch.cat([given, covariates], -1))

    def spread(self, q: Tensor, x: Tensor, strange: Tensor) -> Variables:
        learned = self.learned(q, x)
        sd = self.own.sd_of(learned.weight, learned.features)
        good = torch.logical_and(sd >= 0, sd < torch.inf).all(-1, keepdim=True) & (strange < 1)
        state = status_of(strange, good & (learned.excess <= 0))
        return {"sd": torch.where(good, sd, self.own.fallback_sd), "status": state}

    def finish(  # type: ignore[override]
        self, q: Tensor, strange: Tensor, correction: Tensor, found: Tensor, excess: Tensor
    ) -> Variables:
        command = q - correction
        rounding = self.slack + self.eps * (q.abs() + found.abs())
        # Written so that what is no number is not good.
        right = ((command + found - q).abs() <= rounding).all(-1, keepdim=True)
        good = right & self.own.is_allowed(found) & (strange < 1)
        state = status_of(strange, good & (excess <= 0))
        return {
            "command": torch.where(good, command, q),
            "deviation": torch.where(good, correction, 0.0),
            "status": state,
        }

    def finish_back(  # type: ignore[override]
        self, q: Tensor, strange: Tensor, found: Tensor, excess: Tensor
    ) -> Variables:
        good = self.own.is_allowed(found) & (strange < 1)
        return {"joints": torch.where(good, q + found, q), "status": status_of(strange, good & (excess <= 0))}

    def choose(  # type: ignore[override]
        self,
        q: Tensor,
        strange: Tensor,
        first: Tensor,
        near: Tensor,
        correction: Tensor,
        excess: Tensor,
        doubt: Tensor,
    ) -> Variables:
        good = self.own.is_allowed(correction) & (doubt <= ASTRAY)
        deviation = torch.where(strange < 1, torch.where(good, correction, first), 0.0)
        state = status_of(strange, torch.where(good, excess, near) <= 0, doubt)
        return {"command": q - deviation, "deviation": deviation, "status": state}

    def choose_back(  # type: ignore[override]
        self, q: Tensor, strange: Tensor, first: Tensor, correction: Tensor, excess: Tensor, doubt: Tensor
    ) -> Variables:
        found = self.choose(q, strange, first, excess, correction, excess, doubt)
        return {"joints": found["command"], "status": found["status"]}
