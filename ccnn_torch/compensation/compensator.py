"""From ideal joints to commands that make the machine reach them, and back."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.contraction import TOLERANCE
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.effects.effects import PhysicalEffects
from ccnn_torch.compensation.geometry.identified import Geometry
from ccnn_torch.compensation.networks import UncertainNetwork
from ccnn_torch.compensation.secant import Step, next_correction
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, OutsideDomainWarning
from ccnn_torch.training import Scaling

Hook = Callable[[nn.Module, tuple[Any, ...], dict[str, Any], Tensor], Tensor]


class Solution(NamedTuple):
    """Both directions at once, since the first step of the one is the other.

    Attributes:
        command: joints to command for the ideal joints given, `... x n` [SI].
        deviation: δ at that command, `... x n` [SI].
        inside_domain: whether that command is inside the domain, `...`, bool.
        ideal: ideal joints, were the joints given a command, `... x n` [SI].
        ideal_inside_domain: whether the joints given are inside the domain, `...`, bool.
        deviation_sd: standard deviation of a newly measured δ at the command, `... x n` [SI].
    """

    command: Tensor
    deviation: Tensor
    inside_domain: Tensor
    ideal: Tensor
    ideal_inside_domain: Tensor
    deviation_sd: Tensor


class _Deviation(NamedTuple):
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


class Compensator(nn.Module):
    """A learned deviation δ(q) of commanded joints, guarded and limited, with the command that undoes it.

    Sign: δ is what the machine does beyond the command, ideal = q + δ(q); the command for ideal joints q* solves
    q + δ(q) = q* by `iterations` steps from q*: of q ← q* - δ(q), or with `secant` of Broyden's method, which gains
    more with each. δ is `scaling.restore(network(features))` clamped to ± `limit`, faded by the domain's guard into the
    constant `safe`. Inputs that are no number give the command of the domain's centre, infinite ones that of its edge,
    both with `safe` and outside the domain.

    With `geometry` the network has learned only what identified geometry leaves: with r(q) the network's guarded part
    and γ(q) the deviation of the identified geometry, δ(q) = r(q) + γ(q + r(q)), clamped to ± `limit`. Outside the
    domain r fades into `safe`; γ stays where the geometry `extrapolates` (an arm's links are what they are everywhere)
    and fades to 0 with r where it does not (a polynomial).

    `sd` says how far a newly measured δ may be from this one: inside the domain by the network's own `variance`
    and `sd_scale`, outside by how the training deviations scatter about `safe`, between the two by the guard's weight.

    Attributes:
        network: features -> standardised deviation; operators that ONNX Runtime has in double. Its method `variance`
            gives the variance of a newly measured standardised deviation; without one that is 1 everywhere.
        scaling: of one repeat.
        limit: hard limit of |δ|, `n` [SI].
        safe: correction outside the domain, beside that of a geometry that extrapolates, `n` [SI].
        sd_scale: what the network's standard deviation is multiplied by, as held-out rows demand, `n` [1].
        safe_sd: standard deviation outside the domain, `n` [SI].
        joints, covariates: coordinates in order.
        lipschitz: bound of |∂δ/∂q| with joints in units of their limits (maximum row sum), 1.
        iterations: smallest k with lipschitzᵏ · max|δ| below 1e-12 of the limit; with `secant` the smallest with which
            command + deviation = joints to what exports agree to (1e-12 of the limit, 1e-9 with an arm's links) at
            thousands of points in and around the domain.
        secant: whether steps are those of Broyden's method.
        share: of what the network learned beside its mean that is applied [1]; below 1 where all of it was too steep.
            The scaling has it already, and a model file does not store it.
        geometry: commanded joints `... x n` -> γ `... x n` [SI], bounded for finite joints; None without one.
        effects: commanded joints and covariates -> ε `... x n` [SI]; None without one.
    """

    limit: Tensor
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
        geometry: Geometry | None = None,
        effects: PhysicalEffects | None = None,
        secant: bool = False,
    ) -> None:
        super().__init__()
        self.network = network
        self.geometry = geometry
        self.effects = effects
        self.scaling = scaling
        self.domain = domain
        self.register_buffer("limit", limit)
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

    def forward(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Command, δ at the command `... x n` [SI] each, and whether it is inside the domain `...`.

        Args:
            joints: ideal joints, `... x n` [SI].
            covariates: `... x m` [SI], in the order of `covariates`; None where there are none.

        Raises:
            InputError: covariates are missing, or a last dimension is wrong.
        """
        _, command, last, _ = self._solve(joints, covariates)
        return command, last.value, last.inside

    def deviation(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Guarded and limited δ at *commanded* joints, `... x n` [SI]; arguments and errors as `forward`."""
        joints, covariates, strange = self._inputs(joints, covariates)
        return self._deviation(joints, covariates, strange).value

    def sd(self, joints: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Standard deviation of a newly measured δ at *commanded* joints, model and noise, `... x n` [SI].

        Finite for every input; arguments and errors as `forward`.
        """
        joints, covariates, strange = self._inputs(joints, covariates)
        return self._sd(self._deviation(joints, covariates, strange))

    def sd_of(self, weight: Tensor, features: Tensor) -> Tensor:
        """`sd` where the guard's weight, `... x 1` [1], and the network's features, `... x i` [1], are known."""
        scale = self.scaling.deviation * self.sd_scale
        variance = scale * scale
        if isinstance(self.network, UncertainNetwork):
            variance = variance * self.network.variance(features)
        outside = (1 - weight) * self.safe_sd
        return torch.sqrt(weight * weight * variance + outside * outside)

    def back(self, command: Tensor, covariates: Tensor | None = None) -> Tensor:
        """Ideal joints of a command (or of the joints fed back), `... x n` [SI]; arguments and errors as `forward`."""
        command, covariates, strange = self._inputs(command, covariates)
        return command + self._deviation(command, covariates, strange).value

    def solve(self, joints: Tensor, covariates: Tensor | None = None) -> Solution:
        """Command of ideal joints, and the ideal joints were they a command; arguments and errors as `forward`."""
        joints, command, last, first = self._solve(joints, covariates)
        return Solution(command, last.value, last.inside, joints + first.value, first.inside, self._sd(last))

    def guarded(self, joints: Tensor, covariates: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As `solve`, for deviations and weights instead of joints, which single precision cannot hold.

        Returns:
            δ at the command `... x n` [SI], its weight `... x 1` [1] (1 inside the domain); δ and weight were the
            joints given a command.
        """
        _, _, last, first = self._solve(joints, covariates)
        return last.value, last.weight, first.value, first.weight

    @property
    def export_tolerance(self) -> float:
        """Share of the limit to which exports agree: 1e-12, or what network, geometry or effects ask for."""
        parts = (self.network, self.geometry, self.effects)
        return max(float(getattr(part, "export_tolerance", TOLERANCE)) for part in parts)

    def next_correction(self, deviation: Tensor, correction: Tensor, steps: list[Step]) -> tuple[Tensor, list[Step]]:
        """What to subtract from the ideal joints next; see `secant.next_correction`."""
        return next_correction(deviation, correction, steps, self.limit) if self.secant else (deviation, steps)

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
                    "a command is outside the domain that the compensator was trained on, where it falls back to the "
                    "mean training deviation; this warning is given once",
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

    def _solve(self, joints: Tensor, covariates: Tensor | None) -> tuple[Tensor, Tensor, _Deviation, _Deviation]:
        """Finite joints, their command, δ at the command, and δ at the joints themselves."""
        joints, covariates, strange = self._inputs(joints, covariates)
        first = last = self._deviation(joints, covariates, strange)
        command, correction, steps = joints, torch.zeros_like(joints), list[Step]()
        for _ in range(self.iterations):
            correction, steps = self.next_correction(last.value, correction, steps)
            command = joints - correction
            last = self._deviation(command, covariates, strange)
        return joints, command, last, first

    def _deviation(self, joints: Tensor, covariates: Tensor, strange: Tensor) -> _Deviation:
        """δ at commanded, finite joints."""
        inputs = torch.cat([joints, covariates], -1) if self.covariates else joints
        caged = self.domain.cage(inputs)
        features = self.scaling.features(caged)
        raw = self.scaling.restore(self.network(features))
        excess = self.domain.excess(caged) + strange
        fade = torch.relu(1 - excess)
        weight = fade * fade
        # Two products instead of safe + weight · (limited - safe): each end is then exact.
        value = self._limited(weight * self._limited(raw) + (1 - weight) * self.safe)
        if self.effects is not None:
            moved = self.effects(caged[..., : len(self.joints)] + value, caged[..., len(self.joints) :])
            value = self._limited(value + weight * moved)
        if self.geometry is not None:
            moved = self.geometry(caged[..., : len(self.joints)] + value)
            value = self._limited(value + (moved if self.geometry.extrapolates else weight * moved))
        return _Deviation(value, weight, excess, features)

    def _sd(self, deviation: _Deviation) -> Tensor:
        """Of a newly measured δ, where this one was found."""
        return self.sd_of(deviation.weight, deviation.features)

    def _limited(self, deviation: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(deviation, -self.limit), self.limit)


def default_limit(deviations: Tensor) -> Tensor:
    """Limit of a correction by the training deviations `s x n`: 1.5 times the largest of each joint, `n` [SI]."""
    return 1.5 * deviations.abs().amax(0)
