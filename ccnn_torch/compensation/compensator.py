"""From ideal joints to commands that make the machine reach them, and back."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.machine import Machine
from ccnn_torch.compensation.networks import UncertainNetwork
from ccnn_torch.compensation.outputs import WAYS
from ccnn_torch.compensation.routines import KEPT, Functions, Learned, Variables, routines_of
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, OutsideDomainWarning
from ccnn_torch.training import Scaling

# What is left of the equation q + δ(q) = q*, as a share of the limit.
TOLERANCE = 1e-12
# A bound of 0 takes any correction to 0.
_TINY = 1e-30

Hook = Callable[[nn.Module, tuple[Any, ...], dict[str, Any], Tensor], Tensor]


class Solution(NamedTuple):
    """Command and way back, solved together.

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


class Compensator(nn.Module):
    """The correction of commanded joints: a bounded deviation δ(q), and the command that undoes it.

    Sign: δ is what the machine does beyond the command, ideal = q + δ(q); the command for ideal joints q* solves
    q + δ(q) = q* by `iterations` steps from q* - `safe`: of q ← q* - δ(q), or with `secant` of Broyden's method, which
    gains more with each. δ is `scaling.restore(network(features))` clamped to ± `limit`, faded by the domain's guard
    into the constant `safe`. Inputs that are not finite (the middle of the domain is taken for what is no number, its
    edge for infinity) are commanded as they are, without any correction.

    With a `machine` the network has learned only what that leaves, and the limit and the guard hold for the network
    alone: the machine inverts its own forward map, with what was learned in it, in `iterations` steps, and the whole
    deviation is bounded by `most`.

    `sd` is the standard deviation of a newly measured δ about it: inside the domain by the network's own `variance`
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
        iterations: smallest k with which the command has settled, to 1e-12 of the limit and rounding, at thousands of
            points in and around the domain; without a `machine` at most that with lipschitzᵏ · max|δ| below it.
        secant: whether steps are those of Broyden's method.
        share: of what the network learned beside its mean that is applied [1]; below 1 where all of it was too steep.
            The scaling has it already, and a model file does not store it.
        unsettled: share of regular points in and around the domain at which the machine's command does not settle.
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
        secant: bool = False,
        machine: Machine | None = None,
        most: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        self.machine = machine
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
        found = self.run(joints, covariates, ("command",))
        return found["command"], found["deviation"], found["inside_domain"]

    def deviation(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """δ at *commanded* joints, `... x n` [SI]: that of the way back; arguments and errors as `forward`."""
        return self.run(joints, covariates, ("back",))["back_deviation"]

    def learned(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Guarded and limited part that was learned, at *commanded* joints, `... x n` [SI]; as `forward`."""
        learned, known = self._learned(joints, covariates)
        return torch.where(known, learned.value, 0.0)

    def sd(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Standard deviation of a newly measured δ at *commanded* joints, model and noise, `... x n` [SI].

        Finite for every input; arguments and errors as `forward`.
        """
        learned, known = self._learned(joints, covariates)
        return torch.where(known, self.sd_of(learned.weight, learned.features), self.fallback_sd)

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
        return self.run(command, covariates, ("back",))["ideal"]

    def solve(self, joints: Tensor, covariates: Tensor | None = None) -> Solution:
        """Command of ideal joints, and the ideal joints were they a command; arguments and errors as `forward`."""
        found = self.run(joints, covariates)
        return Solution(*(found[name] for name in Solution._fields))

    def run(self, joints: Tensor, covariates: Tensor | None = None, ways: Collection[str] = WAYS) -> Variables:
        """What is asked for, by name; each of `WAYS` costs its own evaluations, and `sd` is that of a `command`.

        Arguments and errors as `forward`.
        """
        functions, sd = Functions(self), "sd" in ways
        every = routines_of(self, KEPT, sd, ("sure",) if sd else ())
        asked = [routine for routine, way in zip(every, WAYS, strict=False) if way in ways]
        values = functions.start(self._inputs(joints, covariates))
        return reduce(lambda found, routine: functions.run(routine.statements, found), asked, values)

    @property
    def export_tolerance(self) -> float:
        """Share of the limit to which exports agree: 1e-12, or what network or machine ask for."""
        parts = (self.network, self.machine)
        return max(float(getattr(part, "export_tolerance", TOLERANCE)) for part in parts)

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

    def is_allowed(self, correction: Tensor) -> Tensor:
        """Whether a correction `... x n` [SI] is within the bound of the whole deviation, `... x 1`; NaN is not."""
        return (correction.abs() <= self.most * (1 + 1e-9)).all(-1, keepdim=True)

    def shortened(self, correction: Tensor) -> Tensor:
        """A correction `... x n` [SI] brought to the bound of the whole deviation, its direction kept.

        Near a singular pose large motions of several joints cancel: bounded one by one they would miss by far more than
        no correction does.
        """
        beyond = (correction.abs() / torch.clamp_min(self.most, _TINY)).amax(-1, keepdim=True)
        return correction / torch.clamp_min(beyond, 1.0)

    def held(self, covariates: Tensor) -> Tensor:
        """Covariates held at the ends up to which effects follow them."""
        low, high = self.ends
        return torch.minimum(torch.maximum(covariates, low), high)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest covariates that effects follow, `m` each [SI]: what was measured, or wider as was told."""
        n = len(self.joints)
        centre, half = self.domain.centre[n:], self.domain.half_range[n:]
        told = {} if self.machine is None else self.machine.ends
        if not told:
            return centre - half, centre + half
        wide = centre.new_tensor([told.get(c.name, (torch.inf, -torch.inf)) for c in self.covariates])
        return torch.minimum(centre - half, wide[:, 0]), torch.maximum(centre + half, wide[:, 1])

    def limited(self, deviation: Tensor) -> Tensor:
        """Within the limit."""
        return torch.minimum(torch.maximum(deviation, -self.limit), self.limit)

    def _learned(self, joints: Tensor, covariates: Tensor | None) -> tuple[Learned, Tensor]:
        """What was learned at commanded joints, and whether all inputs were finite, `... x 1`."""
        functions = Functions(self)
        found = functions.clean(self._inputs(joints, covariates))
        return functions.learned(found["q"], found["x"]), found["strange"] < 1

    def _inputs(self, joints: Tensor, covariates: Tensor | None) -> Tensor:
        """Joints and covariates side by side, `... x (n + m)` [SI]."""
        n, m = len(self.joints), len(self.covariates)
        if joints.shape[-1] != n:
            names = ", ".join(c.header for c in self.joints)
            raise InputError(f"the compensator takes the {n} joints {names}; got {joints.shape[-1]}")
        if m == 0:
            return joints
        names = ", ".join(c.header for c in self.covariates)
        if covariates is None:
            raise InputError(f"the compensator needs the covariates {names}; give covariates=… with {m} columns")
        if covariates.shape[-1] != m:
            raise InputError(f"the compensator needs the covariates {names}; got {covariates.shape[-1]} columns")
        return torch.cat([joints, covariates.to(joints.dtype)], -1)


def default_limit(deviations: Tensor) -> Tensor:
    """Limit of a correction by the training deviations `s x n`: 1.5 times the largest of each joint, `n` [SI]."""
    return 1.5 * deviations.abs().amax(0)
