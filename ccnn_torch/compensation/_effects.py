"""Physical effects as a deviation of the joints: the objects that a diagnosis fits, at work in a compensator."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.compensation._exact_numbers import exact_numbers
from ccnn_torch.compensation._fields import Fields, looked_at, make_fields
from ccnn_torch.compensation._serial_geometry import _inverse
from ccnn_torch.effects import Acting, Situation, make_effect
from ccnn_torch.mechanisms import Mechanism, mechanism_from_description

__all__ = ["PhysicalEffects", "effect_deviation", "expand_effects", "gains"]

# Joints that move the platform less than this are held back [m per joint unit]: a thousandth of what is usual.
_LEAST_DAMPING = 1e-3
# A Jacobian from here on is none.
_LOST = 1e6


def effect_deviation(
    here: Situation,
    acting: Sequence[Acting],
    jacobian: Callable[[Tensor], Tensor],
    rotation_weight: float,
    damping: float,
    gain: float = math.inf,
) -> Tensor:
    """Joint deviation with which the nominal machine stands where the machine with the effects stands.

    Effects on joints count as they are. The change of the pose by the others is brought to the joints by the damped
    inverse of the Jacobian half way (the midpoint rule), which leaves the third order of the deviation.

    Args:
        here: the rows as commanded.
        acting: effects with their numbers.
        jacobian: of position and rotation vector, at joints `... x s x n` -> `... x s x c x n`.
        rotation_weight: of rotation against position [m/rad].
        damping: directions in which a joint moves the platform less than this are held back [m per joint unit].
        gain: where the joints move the platform by more than this (Frobenius norm of the weighted Jacobian), near a
            singular pose, the deviation fades out, over another 40 % [m per joint unit].

    Returns:
        `... x s x n` [joint's unit], finite.
    """
    fade = None if math.isinf(gain) else _fading(here.jacobian, rotation_weight, gain)
    moved, shift = torch.zeros_like(here.joints), None
    for one in acting:
        change = one.change(here)
        if one.effect.kind == "joints":
            moved = moved + change
            continue
        if one.effect.kind == "parameters":
            change = (here.parameter_jacobian @ change.unsqueeze(-1)).squeeze(-1)
        shift = change if shift is None else shift + change
    moved = torch.nan_to_num(moved, posinf=0.0, neginf=0.0)
    if shift is None:
        return moved if fade is None else fade * moved
    shift = torch.nan_to_num(shift, posinf=0.0, neginf=0.0)
    first = _lifted(here.jacobian, shift, rotation_weight, damping)
    found = moved + _lifted(jacobian(here.joints + moved + 0.5 * first), shift, rotation_weight, damping)
    return found if fade is None else fade * found


class PhysicalEffects(nn.Module):
    """`effect_deviation` of one machine with known numbers, for one row at a time, as a graph that can be exported.

    A row knows nothing of the rows before it: effects act as on a machine that has settled under its covariates.

    Attributes:
        mechanism: the nominal one, frames fitted.
        covariates: names of the columns that come with the joints.
        acting: effects with their numbers; their own code runs on the fields.
        fields: what the effects see of the nominal machine.
        gravity: `3` [m/s²].
        numbers: of every effect by name and coefficient, for the model's card.
        export_tolerance: share of the limit to which exports agree.
    """

    export_tolerance = 1e-9
    gravity: Tensor

    def __init__(
        self,
        mechanism: Mechanism,
        gravity: Tensor,
        covariates: Sequence[str],
        acting: Sequence[Acting],
        fields: Fields,
        rotation_weight: float,
        damping: float,
        gain: float,
        numbers: Mapping[str, Mapping[str, float]],
    ) -> None:
        super().__init__()
        # In a tuple, since the mechanism's own buffers are no part of the model.
        self._mechanism = (mechanism,)
        self.covariates = list(covariates)
        self.fields = fields
        self.rotation_weight, self.damping, self.gain = rotation_weight, damping, gain
        self.numbers = {name: dict(values) for name, values in numbers.items()}
        self.register_buffer("gravity", gravity.detach().clone())
        self._names = [one.effect.name for one in acting]
        self._effects = [one.effect for one in acting]
        for i, one in enumerate(acting):
            self.register_buffer(f"shape{i}", one.shape.detach().clone())
            self.register_buffer(f"coefficients{i}", one.coefficients.detach().clone())

    @property
    def acting(self) -> list[Acting]:
        """The effects with their numbers."""
        return [
            Acting(effect, getattr(self, f"shape{i}"), getattr(self, f"coefficients{i}"))
            for i, effect in enumerate(self._effects)
        ]

    def forward(self, joints: Tensor, covariates: Tensor) -> Tensor:
        """joints: commanded, `... x n` [SI]; covariates: `... x m` [SI]; returns the deviation, `... x n` [SI]."""
        rows = joints.reshape(-1, joints.shape[-1])
        columns = covariates.reshape(-1, covariates.shape[-1]) if self.covariates else covariates
        given = {name: columns[:, i] for i, name in enumerate(self.covariates) if name != "time"}
        with exact_numbers():
            here = self.fields.fill(Situation(self._mechanism[0], rows, given, self.gravity))
            settings = self.rotation_weight, self.damping, self.gain
            found = effect_deviation(here, self.acting, self.fields.jacobian, *settings)
        return found.reshape(joints.shape)

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the tensors stand beside it."""
        return {
            "kind": "physical_effects",
            "mechanism": self._mechanism[0].describe(),
            "covariates": self.covariates,
            "acting": [[one.effect.name, len(one.shape), len(one.coefficients)] for one in self.acting],
            "fields": self.fields.describe(),
            "rotation_weight": self.rotation_weight,
            "damping": self.damping,
            "gain": None if math.isinf(self.gain) else self.gain,
            "numbers": self.numbers,
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> PhysicalEffects:
        """The module as it was described, its tensors 0."""
        mechanism = mechanism_from_description(description["mechanism"])
        acting = [
            Acting(make_effect(name), *(torch.zeros(size, dtype=torch.float64) for size in sizes))
            for name, *sizes in description["acting"]
        ]
        return cls(
            mechanism,
            torch.zeros(3, dtype=torch.float64),
            description["covariates"],
            acting,
            Fields.from_description(description["fields"], mechanism),
            description["rotation_weight"],
            description["damping"],
            math.inf if description["gain"] is None else description["gain"],
            description["numbers"],
        )


def expand_effects(
    situation: Situation,
    acting: Sequence[Acting],
    covariates: Sequence[str],
    margin: float = 0.1,
    rotation_weight: float = 0.04,
    damping: float = 0.0,
    gain: float = math.inf,
) -> PhysicalEffects:
    """Effects with their numbers as a module that a model file can hold.

    Args:
        situation: the training rows, `s x n`; of its parameters the nominal ones are taken.
        acting: effects of the library, without time.
        covariates: names of the compensator's covariates, in order.
        margin: of the compensator's domain.
        rotation_weight, damping, gain: as in `effect_deviation`.

    Raises:
        InputError, MethodFailedError: what the effects see of the machine cannot be expanded over these joints.
    """
    mechanism, few = situation.mechanism, slice(0, 8)
    given = {name: value[few] for name, value in situation.covariates.items()}
    names = {"jacobian"} if any(one.effect.kind != "joints" for one in acting) else set()
    for one in acting:
        names |= looked_at(Situation(mechanism, situation.joints[few], given, situation.gravity), one.change)
        if one.effect.kind == "parameters":
            names.add("parameter_jacobian")
    if not names:
        # Nothing of the kinematics is looked at, so nothing goes wrong near a singular pose.
        gain = math.inf
    elif not math.isinf(gain):
        names.add("jacobian")
    fields = make_fields(mechanism, situation.gravity, names, situation.joints, margin)
    numbers = {
        one.effect.name: dict(
            zip(
                [c.name for c in (*one.effect.coefficients(situation), *one.effect.shapes(situation))],
                [*one.coefficients.tolist(), *one.shape.tolist()],
                strict=True,
            )
        )
        for one in acting
    }
    return PhysicalEffects(
        mechanism, situation.gravity, covariates, acting, fields, rotation_weight, damping, gain, numbers
    ).requires_grad_(False)


def gains(jacobian: Tensor, rotation_weight: float) -> Tensor:
    """How far the joints move the platform: Frobenius norm of the Jacobian, `... x c x n` -> `...` [m per unit]."""
    return _squares(jacobian, rotation_weight).sqrt()


def _squares(jacobian: Tensor, rotation_weight: float) -> Tensor:
    return (jacobian * _weights(jacobian, rotation_weight).unsqueeze(-1)).square().sum((-2, -1))


def _fading(jacobian: Tensor, rotation_weight: float, gain: float) -> Tensor:
    """1 where the Jacobian is as usual, 0 where it is 1.4 times the most, `... x s x 1`."""
    known = torch.nan_to_num(jacobian, nan=_LOST, posinf=_LOST, neginf=-_LOST)
    excess = torch.relu(_squares(known, rotation_weight) / gain**2 - 1)
    fade = torch.relu(1 - excess)
    return (fade * fade).unsqueeze(-1)


def _weights(jacobian: Tensor, rotation_weight: float) -> Tensor:
    return torch.tensor([1.0] * 3 + [rotation_weight] * (jacobian.shape[-2] - 3), dtype=jacobian.dtype)


def _lifted(jacobian: Tensor, shift: Tensor, rotation_weight: float, damping: float) -> Tensor:
    """Change of the joints that comes closest to a change of the pose, `... x s x n`."""
    # A comparison with NaN is false.
    slope = torch.where(jacobian.abs() < _LOST, jacobian, torch.zeros_like(jacobian))
    weight = _weights(slope, rotation_weight)
    slope = slope * weight.unsqueeze(-1)
    unit = torch.eye(slope.shape[-1], dtype=slope.dtype)
    inverse = _inverse(slope.mT @ slope + max(damping, _LEAST_DAMPING) ** 2 * unit, unit)
    found: Tensor = inverse @ (slope.mT @ (weight * shift).unsqueeze(-1))
    return found.squeeze(-1)
