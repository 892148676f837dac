"""From ideal joints to commands that make the machine reach them, and back."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.contraction import TOLERANCE
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.effects import PhysicalEffects
from ccnn_torch.compensation.expansions import ChebyshevExpansion
from ccnn_torch.compensation.machine import ASTRAY, SETTLED, Machine
from ccnn_torch.compensation.networks import UncertainNetwork
from ccnn_torch.compensation.secant import Step, next_correction
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, OutsideDomainWarning
from ccnn_torch.training import Scaling

Hook = Callable[[nn.Module, tuple[Any, ...], dict[str, Any], Tensor], Tensor]


EXACT, OUTSIDE, NOT_FINITE, DAMPED = range(4)
"""Status of a command: exact; outside what was measured; an input is not finite, and the command is the joints; damped
near a singular pose, at a limit or not settled, and the command is the nearest safe one."""


class Solution(NamedTuple):
    """Both directions at once, since the first step of the one is the other.

    Attributes:
        command: joints to command for the ideal joints given, `... x n` [SI].
        deviation: what the machine does beyond the command: ideal joints less command, `... x n` [SI].
        inside_domain: whether that command is inside the domain, `...`, bool.
        ideal: ideal joints, were the joints given a command, `... x n` [SI].
        ideal_inside_domain: whether the joints given are inside the domain, `...`, bool.
        deviation_sd: standard deviation of a newly measured δ at the command, `... x n` [SI].
        status, ideal_status: of either direction, `...`, int64: `EXACT`, `OUTSIDE`, `NOT_FINITE` or `DAMPED`.
    """

    command: Tensor
    deviation: Tensor
    inside_domain: Tensor
    ideal: Tensor
    ideal_inside_domain: Tensor
    deviation_sd: Tensor
    status: Tensor
    ideal_status: Tensor


class _Learned(NamedTuple):
    """δ `... x n` [SI]; its weight against the safe correction, and the guard's excess, `... x 1` [1] each; and the
    network's features there, `... x i` [1]."""

    value: Tensor
    weight: Tensor
    excess: Tensor
    features: Tensor

    @property
    def inside(self) -> Tensor:
        """Whether inside the domain, `...`, bool."""
        return self.excess.squeeze(-1) <= 0


class _Way(NamedTuple):
    """One direction: what was subtracted, and δ at the command, `... x n` [SI] each, what was learned there, and
    whether it is not the exact one, `... x 1`: above 0."""

    correction: Tensor
    deviation: Tensor
    learned: _Learned
    doubt: Tensor


class Compensator(nn.Module):
    """A learned deviation δ(q) of commanded joints, guarded and limited, with the command that undoes it.

    Sign: δ is what the machine does beyond the command, ideal = q + δ(q); the command for ideal joints q* solves
    q + δ(q) = q* by `iterations` steps from q*: of q ← q* - δ(q), or with `secant` of Broyden's method, which gains
    more with each. δ is `scaling.restore(network(features))` clamped to ± `limit`, faded by the domain's guard into the
    constant `safe`. Inputs that are not finite (the middle of the domain is taken for what is no number, its edge for
    infinity) are commanded as they are, without any correction.

    With a `machine` the network has learned only what that leaves, and the limit and the guard hold for the network
    alone: the machine inverts its own forward map, with what was learned in it, in `iterations` steps, and the whole
    deviation is bounded by `most`. With `geometry` and `effects`, the expansions of machines without closed forms, r(q)
    the network's guarded part and γ(q) their deviation, δ(q) = r(q) + γ(q + r(q)), which fades with r.

    `sd` says how far a newly measured δ may be from this one: inside the domain by the network's own `variance`
    and `sd_scale`, outside by how the training deviations scatter about `safe`, between the two by the guard's weight.

    Attributes:
        network: features -> standardised deviation; operators that ONNX Runtime has in double. Its method `variance`
            gives the variance of a newly measured standardised deviation; without one that is 1 everywhere.
        scaling: of one repeat.
        limit: hard limit of |δ|, `n` [SI].
        safe: correction outside the domain, `n` [SI].
        most: bound of the whole deviation, `n` [SI]; the limit where there is no machine.
        sd_scale: what the network's standard deviation is multiplied by, as held-out rows demand, `n` [1].
        safe_sd: standard deviation outside the domain, `n` [SI].
        joints, covariates: coordinates in order.
        lipschitz: bound of |∂δ/∂q| with joints in units of their limits (maximum row sum), 1.
        iterations: smallest k with lipschitzᵏ · max|δ| below 1e-12 of the limit; with `secant` or a `machine` the
            smallest with which the command has settled at thousands of points in and around the domain.
        secant: whether steps are those of Broyden's method.
        share: of what the network learned beside its mean that is applied [1]; below 1 where all of it was too steep.
            The scaling has it already, and a model file does not store it.
        unsettled: share of regular points in and around the domain at which the machine's command does not settle.
        geometry: commanded joints `... x n` -> γ(q) = g(f(q)) - q, `... x n` [SI], f the identified forward and g the
            nominal inverse kinematics; None without one.
        effects: commanded joints and covariates -> ε `... x n` [SI]; None without one.
        machine: the one that was identified; None without one.
    """

    limit: Tensor
    most: Tensor
    safe: Tensor
    sd_scale: Tensor
    safe_sd: Tensor

    def __init__(
        self,
        network: nn.Module,
        scaling: Scaling,
        domain: Domain,
        limit: Tensor,
        safe: Tensor,
        joints: Sequence[Coordinate],
        covariates: Sequence[Coordinate],
        lipschitz: float,
        iterations: int,
        sd_scale: Tensor | None = None,
        safe_sd: Tensor | None = None,
        geometry: ChebyshevExpansion | None = None,
        effects: PhysicalEffects | None = None,
        secant: bool = False,
        machine: Machine | None = None,
        most: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        self.machine = machine
        self.geometry = geometry
        self.effects = effects
        self.scaling = scaling
        self.domain = domain
        self.register_buffer("limit", limit)
        self.register_buffer("most", limit.clone() if most is None else most)
        self.register_buffer("safe", safe)
        # The training deviations are seldom at hand where a compensator is put together by hand; their standard
        # deviation about their mean is in the scaling.
        self.register_buffer("sd_scale", torch.ones_like(safe) if sd_scale is None else sd_scale)
        self.register_buffer("safe_sd", scaling.deviation.clone() if safe_sd is None else safe_sd)
        self.joints = tuple(joints)
        self.covariates = tuple(covariates)
        self.lipschitz = lipschitz
        self.iterations = iterations
        self.secant = secant
        self.share = 1.0
        self.unsettled = 0.0

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Command, δ at the command `... x n` [SI] each, and whether it is inside the domain `...`.

        Args:
            joints: ideal joints, `... x n` [SI].
            covariates: `... x m` [SI], in the order of `covariates`; None where there are none.

        Raises:
            InputError: covariates are missing, or a last dimension is wrong.
        """
        found = self.solve(joints, covariates)
        return found.command, found.deviation, found.inside_domain

    def deviation(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """δ at *commanded* joints, `... x n` [SI]: that of the way back; arguments and errors as `forward`."""
        joints, covariates, strange = self._inputs(joints, covariates)
        return self._back(joints, covariates, strange).deviation

    def learned(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Guarded and limited part that was learned, at *commanded* joints, `... x n` [SI]; as `forward`."""
        return self._learned(*self._inputs(joints, covariates)).value

    def sd(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Standard deviation of a newly measured δ at *commanded* joints, model and noise, `... x n` [SI].

        Finite for every input; arguments and errors as `forward`.
        """
        joints, covariates, strange = self._inputs(joints, covariates)
        return self._sd(self._learned(joints, covariates, strange), strange)

    def sd_of(self, weight: Tensor, features: Tensor) -> Tensor:
        """`sd` where the guard's weight, `... x 1` [1], and the network's features, `... x i` [1], are known."""
        scale = self.scaling.deviation * self.sd_scale
        variance = scale * scale
        if isinstance(self.network, UncertainNetwork):
            variance = variance * self.network.variance(features)
        outside = (1 - weight) * self.safe_sd
        return torch.sqrt(weight * weight * variance + outside * outside)

    @property
    def fallback_sd(self) -> Tensor:
        """Standard deviation where the deviation is taken as 0, `n` [SI]."""
        return torch.hypot(self.safe, self.safe_sd)

    def back(self, command: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Ideal joints of a command (or of the joints fed back), `... x n` [SI]; arguments and errors as `forward`."""
        command, covariates, strange = self._inputs(command, covariates)
        return command - self._back(command, covariates, strange).correction

    def solve(self, joints: Tensor, covariates: Tensor | None = None) -> Solution:
        """Command of ideal joints, and the ideal joints were they a command; arguments and errors as `forward`."""
        joints, covariates, strange = self._inputs(joints, covariates)
        there, back = self._command(joints, covariates, strange), self._back(joints, covariates, strange)
        return Solution(
            joints - there.correction,
            there.deviation,
            there.learned.inside,
            joints - back.correction,
            back.learned.inside,
            self._sd(there.learned, strange),
            *(status_of(strange, way.learned.excess <= 0, way.doubt).squeeze(-1) for way in (there, back)),
        )

    def guarded(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As `solve`, for deviations and weights instead of joints, which single precision cannot hold.

        Returns:
            δ at the command `... x n` [SI], its weight `... x 1` [1] (1 inside the domain); δ and weight were the
            joints given a command.
        """
        joints, covariates, strange = self._inputs(joints, covariates)
        there, back = self._command(joints, covariates, strange), self._back(joints, covariates, strange)
        return there.deviation, there.learned.weight, back.deviation, back.learned.weight

    @property
    def export_tolerance(self) -> float:
        """Share of the limit to which exports agree: 1e-12, or what network, geometry or effects ask for."""
        parts = (self.network, self.geometry, self.effects, self.machine)
        return max(float(getattr(part, "export_tolerance", TOLERANCE)) for part in parts)

    def next_correction(self, deviation: Tensor, correction: Tensor, steps: list[Step]) -> tuple[Tensor, list[Step]]:
        """What to subtract from the ideal joints next; see `secant.next_correction`."""
        return next_correction(deviation, correction, steps, self.most) if self.secant else (deviation, steps)

    def hook(self, warn: bool = True) -> Hook:
        """For `mechanism.inverse_kinematics.register_forward_hook(compensator.hook(), with_kwargs=True)`.

        Covariates travel as the keyword `covariates` of the call, `... x m`. A pose without inverse kinematics stays
        NaN, since no correction makes it reachable; joints whose command is not finite (a network out of a file may
        give anything) stay as they are.

        Args:
            warn: warn once with `OutsideDomainWarning` when a command is outside the domain; False inside torch.func
                transforms, where nothing can be asked of a value.
        """
        warned = not warn

        def compensate(module: nn.Module, args: tuple[Any, ...], kwargs: Mapping[str, Any], output: Tensor) -> Tensor:
            nonlocal warned
            covariates = kwargs.get("covariates")
            if covariates is not None:
                covariates = covariates.expand(*output.shape[:-1], covariates.shape[-1])
            command, _, inside = self(output, covariates)
            solved = torch.isfinite(output).all(-1)
            if not warned and bool((solved & ~inside).any()):
                warned = True
                warnings.warn(
                    "a command is outside the domain that the compensator was trained on, where what it learned fades "
                    "into the mean training deviation; this warning is given once",
                    OutsideDomainWarning,
                    stacklevel=2,
                )
            good = solved & torch.isfinite(command).all(-1)
            return torch.where(good.unsqueeze(-1), command, output)

        return compensate

    def _inputs(self, joints: Tensor, covariates: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Finite joints and covariates, and how many inputs were not finite, `... x 1`."""
        n, m = len(self.joints), len(self.covariates)
        if joints.shape[-1] != n:
            names = ", ".join(c.header for c in self.joints)
            raise InputError(f"the compensator takes the {n} joints {names}; got {joints.shape[-1]}")
        if m == 0:
            finite = self.domain.clean(joints)
            return finite.inputs, joints.new_zeros(*joints.shape[:-1], 0), finite.strange
        names = ", ".join(c.header for c in self.covariates)
        if covariates is None:
            raise InputError(f"the compensator needs the covariates {names}; give covariates=… with {m} columns")
        if covariates.shape[-1] != m:
            raise InputError(f"the compensator needs the covariates {names}; got {covariates.shape[-1]} columns")
        finite = self.domain.clean(torch.cat([joints, covariates.to(joints.dtype)], -1))
        return finite.inputs[..., :n], finite.inputs[..., n:], finite.strange

    def _command(self, joints: Tensor, covariates: Tensor, strange: Tensor) -> _Way:
        """From finite ideal joints to the command."""
        correction, steps = torch.zeros_like(joints), list[Step]()
        aim = joints[..., :0] if self.machine is None else self.machine.aim(joints)
        first, found, doubt = self.step(joints, covariates, strange, correction, aim)
        last, start = first, found
        for _ in range(self.iterations):
            correction, steps = self.next_correction(found, correction, steps)
            last, found, doubt = self.step(joints - correction, covariates, strange, correction, aim)
        if self.machine is None:
            known = strange <= 0
            return _Way(torch.where(known, correction, 0.0), torch.where(known, found, 0.0), last, doubt)
        good = self.is_allowed(correction) & (doubt <= ASTRAY)
        learned = _Learned(*(torch.where(good, a, b) for a, b in zip(last, first, strict=True)))
        given = torch.where(strange <= 0, torch.where(good, correction, start), 0.0)
        return _Way(given, given, learned, doubt)

    def step(
        self, command: Tensor, covariates: Tensor, strange: Tensor, correction: Tensor, aim: Tensor
    ) -> tuple[_Learned, Tensor, Tensor]:
        """What was learned at a command, the correction to try next `... x n` [SI], and whether this one is not
        the exact one, `... x 1`: above 0.

        Args:
            command, correction: tried, `... x n` [SI]; they add up to the ideal joints.
            covariates, strange: as `_inputs` gives them.
            aim: of the machine; nothing without one.
        """
        learned = self._learned(command, covariates, strange)
        if self.machine is None:
            return learned, self._deviation(command, covariates, learned), torch.zeros_like(learned.excess)
        moved = command + learned.value
        wanted = self.machine.next_correction(moved, self._held(covariates), command + correction, correction, aim)
        return learned, *self._settled(command + correction, wanted, correction, aim)

    def step_back(self, ideal: Tensor, correction: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
        """As `step` for the way back of a machine: command less ideal joints to try next, and doubt."""
        assert self.machine is not None
        wanted = self.machine.next_back(ideal, correction, aim)
        return self._settled(None, wanted, correction, aim)

    def aim_back(self, command: Tensor, covariates: Tensor, strange: Tensor) -> tuple[_Learned, Tensor]:
        """What was learned at a command, and the machine's aim for the way back."""
        assert self.machine is not None
        learned = self._learned(command, covariates, strange)
        return learned, self.machine.aim_back(command + learned.value, self._held(covariates))

    def _settled(self, ideal: Tensor | None, wanted: Tensor, correction: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
        """The next correction within its bounds, and whether the one at hand is damped, at a bound or on its way."""
        assert self.machine is not None
        if ideal is None:
            bounded = torch.minimum(torch.maximum(wanted, -self.most), self.most)
        else:
            bounded = self.machine.within(ideal, wanted, self.most)
        ones = torch.ones_like(self.most).unsqueeze(-1)
        away = torch.relu((wanted - correction).abs() - SETTLED) @ ones
        return bounded, away + aim[..., -1:]

    def is_allowed(self, correction: Tensor) -> Tensor:
        """Whether a correction `... x n` [SI] is within the bound of the whole deviation, `... x 1`; NaN is not."""
        return (correction.abs() <= self.most * (1 + 1e-9)).all(-1, keepdim=True)

    def _back(self, command: Tensor, covariates: Tensor, strange: Tensor) -> _Way:
        """From a finite command to the ideal joints."""
        if self.machine is None:
            learned = self._learned(command, covariates, strange)
            found, doubt = -self._deviation(command, covariates, learned), torch.zeros_like(strange)
        else:
            learned, aim = self.aim_back(command, covariates, strange)
            start, doubt = self.step_back(command, torch.zeros_like(command), aim)
            found = start
            for _ in range(self.iterations):
                correction = found
                found, doubt = self.step_back(command - correction, correction, aim)
            found = torch.where(self.is_allowed(correction) & (doubt <= ASTRAY), correction, start)
        given = torch.where(strange <= 0, found, 0.0)
        return _Way(given, -given, learned, doubt)

    def _learned(self, joints: Tensor, covariates: Tensor, strange: Tensor) -> _Learned:
        """What was learned, at commanded, finite joints."""
        inputs = torch.cat([joints, covariates], -1) if self.covariates else joints
        caged = self.domain.cage(inputs)
        features = self.scaling.features(caged)
        raw = self.scaling.restore(self.network(features))
        excess = self.domain.excess(caged) + strange
        fade = torch.relu(1 - excess)
        weight = fade * fade
        # Two products instead of safe + weight · (limited - safe): each end is then exact.
        value = self._limited(weight * self._limited(raw) + (1 - weight) * self.safe)
        return _Learned(value, weight, excess, features)

    def _deviation(self, joints: Tensor, covariates: Tensor, learned: _Learned) -> Tensor:
        """δ at commanded, finite joints, without a machine."""
        value, n = learned.value, len(self.joints)
        if self.effects is None and self.geometry is None:
            return value
        caged = self.domain.cage(torch.cat([joints, covariates], -1) if self.covariates else joints)
        if self.effects is not None:
            value = self._limited(value + learned.weight * self.effects(caged[..., :n] + value, caged[..., n:]))
        if self.geometry is not None:
            value = self._limited(value + learned.weight * self.geometry(caged[..., :n] + value))
        return value

    def _held(self, covariates: Tensor) -> Tensor:
        """Covariates held at the ends of what was measured."""
        n = len(self.joints)
        centre, half = self.domain.centre[n:], self.domain.half_range[n:]
        return torch.minimum(torch.maximum(covariates, centre - half), centre + half)

    def _sd(self, learned: _Learned, strange: Tensor) -> Tensor:
        """Of a newly measured δ, where this one was learned."""
        return torch.where(strange <= 0, self.sd_of(learned.weight, learned.features), self.fallback_sd)

    def _limited(self, deviation: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(deviation, -self.limit), self.limit)


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
    return torch.where(strange > 0, NOT_FINITE, found)


def default_limit(deviations: Tensor) -> Tensor:
    """Limit of a correction by the training deviations `s x n`: 1.5 times the largest of each joint, `n` [SI]."""
    return 1.5 * deviations.abs().amax(0)
