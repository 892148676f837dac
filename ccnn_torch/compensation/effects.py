"""Physical effects as a joint deviation in a compensator."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.expansions import ChebyshevExpansion, expand
from ccnn_torch.compensation.kinematics import ClosedKinematics
from ccnn_torch.effects import Acting, Situation, labelled, make_effect
from ccnn_torch.mechanisms import Mechanism, SerialArm, mechanism_from_description

# Share by which a polynomial of what an effect looks at may be off: that share of an effect, which is small itself, is
# then missed, and held-out rows are commanded with it.
_OF_EFFECT = 0.03
_WHAT = "kinematics that the effects need"
_NAMES = (
    "jacobian",
    "parameter_jacobian",
    "own_weight_torque",
    "inner_weight_torque",
    "weight_torque",
    "holding",
    "frame_slope",
    "visible",
    "pose",
    "platform",
)
# Change of a joint or pose from which on it is none of a machine, but of one that has no such pose [m, rad]: a winch
# may be some turns off, and derivatives of 1e9 make 1e3 of the least effect.
_MOST = 100.0
# Error of a pose from which Newton's method comes to the right one, as a share of the largest.
_START = 0.1
# Parts of `platform`.
_POSITION, _ROTATION = "platform position", "platform rotation"


class _Watched(Situation):
    """Records which quantities are read."""

    def __getattribute__(self, name: str) -> Any:
        if name in _NAMES:
            object.__getattribute__(self, "__dict__").setdefault("_seen", set()).add(name)
        return object.__getattribute__(self, name)


def looked_at(situation: Situation, use: Callable[[Situation], object]) -> set[str]:
    """Names of the nominal machine's quantities that `use` takes from a situation.

    Args:
        situation: some rows, of which nothing has been worked out yet.
    """
    use(situation)
    watched = _Watched(situation.mechanism, situation.joints, situation.covariates, situation.gravity)
    # With everything at hand nothing is read only to compute something else.
    watched.__dict__.update({name: value for name, value in situation.__dict__.items() if name in _NAMES})
    use(watched)
    seen: set[str] = watched.__dict__.get("_seen", set())
    return seen


class Fields(nn.Module):
    """Quantities of the nominal machine as functions of the commanded joints.

    Attributes:
        layout: name and shape of each quantity.
        source: a polynomial from joints `... x n` to the quantities side by side, `... x o` [SI], or a
            `ClosedKinematics`, which gives them by name; None of an arm, which has them in closed form itself, and
            where none is read.
        typical_torque, low, high, down: what a `Situation` takes from the workspace and from gravity.
    """

    typical_torque: Tensor
    low: Tensor
    high: Tensor
    down: Tensor

    def __init__(
        self,
        layout: list[tuple[str, tuple[int, ...]]],
        source: nn.Module | None,
        constants: dict[str, Tensor],
        samples: Situation,
    ) -> None:
        """constants: the tensors that are the same everywhere, by name; samples: of the workspace."""
        super().__init__()
        self.layout = layout
        self.source = source
        self._samples = (samples,)
        for name in ("typical_torque", "low", "high", "down"):
            self.register_buffer(name, constants[name].detach().clone())

    def fill(self, situation: Situation) -> Situation:
        """The same situation with everything that effects look at in it; fresh, with joints `s x n`."""
        values: dict[str, Any] = dict(self.values(situation.joints))
        if _POSITION in values:
            values["platform"] = values.pop(_POSITION), values.pop(_ROTATION, None)
        constants = {
            "typical_torque": self.typical_torque,
            "workspace": (self.low, self.high),
            "down": self.down,
            "samples": self._samples[0],
        }
        # A cached property that is in the instance's dictionary is not computed again.
        situation.__dict__.update(values | constants)
        return situation

    def values(self, joints: Tensor) -> dict[str, Tensor]:
        """The quantities at joints `s x n`, each `s x shape`."""
        machine, names = self._samples[0].mechanism, {name for name, _ in self.layout}
        if isinstance(machine, SerialArm):
            return _of_arm(machine, joints, names)
        if self.source is None:
            return {}
        if isinstance(self.source, ClosedKinematics):
            return self.source.quantities(joints, names)
        flat = self.source(joints)
        out, start = {}, 0
        for name, shape in self.layout:
            end = start + math.prod(shape)
            out[name] = flat[..., start:end].reshape(*joints.shape[:-1], *shape)
            start = end
        return out

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the tensors are stored beside it."""
        polynomial = self.source.start if isinstance(self.source, ClosedKinematics) else self.source
        degree = polynomial.degree if isinstance(polynomial, ChebyshevExpansion) else None
        return {"layout": [[name, list(shape)] for name, shape in self.layout], "degree": degree}

    @classmethod
    def from_description(cls, description: dict[str, Any], mechanism: Mechanism) -> Fields:
        """Fields of the described shape, their tensors without meaning."""
        layout = [(name, tuple(shape)) for name, shape in description["layout"]]
        n, degree, closed = len(mechanism.joints), description["degree"], mechanism.closed_form is not None
        blank = torch.ones(n, dtype=torch.float64)
        polynomial: ChebyshevExpansion | None = None
        if degree is not None:
            outputs = len(mechanism.pose) if closed else sum(math.prod(shape) for _, shape in layout)
            polynomial = ChebyshevExpansion(blank.clone(), blank.clone(), degree, outputs=outputs)
        source = ClosedKinematics(mechanism, polynomial) if layout and closed else polynomial
        sizes = {"typical_torque": n, "low": n, "high": n, "down": 3}
        constants = {k: torch.ones(v, dtype=torch.float64) for k, v in sizes.items()}
        samples = Situation(mechanism, blank[None], {}, torch.zeros(3, dtype=torch.float64)).samples
        return cls(layout, source, constants, samples)


def _of_arm(arm: SerialArm, joints: Tensor, names: set[str]) -> dict[str, Tensor]:
    """What a `Situation` makes the others of; an arm's pose, from which it has these itself, is no closed form."""
    if not names:
        return {}
    unit = torch.eye(arm.compared, dtype=joints.dtype)
    found = {"jacobian": arm.jacobian(joints), "frame_slope": unit.expand(len(joints), -1, -1)}
    return found | ({"parameter_jacobian": arm.parameter_jacobian(joints)} if "parameter_jacobian" in names else {})


def make_fields(mechanism: Mechanism, gravity: Tensor, names: set[str], joints: Tensor, margin: float) -> Fields:
    """Quantities of the nominal machine over the domain of the training rows.

    Args:
        gravity: `3` [m/s²], base frame.
        joints: commanded joints of the training rows, `s x n` [SI].

    Raises:
        InputError, MethodFailedError: as `expand`.
    """

    def quantities(points: Tensor) -> dict[str, Tensor]:
        situation = Situation(mechanism, points, {}, gravity)
        # Where the machine cannot take the pose, other quantities are 0 and the Jacobian is NaN.
        lost = torch.where(torch.isfinite(situation.jacobian).flatten(1).all(-1), 0.0, torch.nan)
        found: dict[str, Tensor] = {}
        for name in _NAMES:
            if name in names and name != "platform":
                found[name] = getattr(situation, name)
        if "platform" in names:
            position, rotation = situation.platform
            found |= {_POSITION: position} | ({} if rotation is None else {_ROTATION: rotation})
        return {
            name: value.expand(len(points), *value.shape[1:]) + lost.reshape(-1, *[1] * (value.dim() - 1))
            for name, value in found.items()
        }

    def flat(points: Tensor) -> Tensor:
        return torch.cat([value.flatten(1) for value in quantities(points).values()], -1)

    whole = Situation(mechanism, joints[:2], {}, gravity)
    low, high = whole.workspace
    constants = {"typical_torque": whole.typical_torque, "low": low, "high": high, "down": whole.down}
    layout = [(name, tuple(value.shape[1:])) for name, value in quantities(joints[:2]).items()]
    source: nn.Module | None = None
    if not layout or isinstance(mechanism, SerialArm):
        pass
    elif mechanism.closed_form is not None:
        start = None
        if mechanism.closed_form == "inverse":
            start = expand(lambda q: Situation(mechanism, q, {}, gravity).pose, joints, margin, _WHAT, worst=_START)
        source = ClosedKinematics(mechanism, start)
    else:
        groups = [math.prod(shape) for _, shape in layout]
        source = expand(flat, joints, margin, _WHAT, groups, _OF_EFFECT)
    return Fields(layout, source, constants, whole.samples)


class PhysicalEffects(nn.Module):
    """Effects of one machine with known numbers, for one row at a time, as a graph that can be exported.

    A row knows nothing of the rows before it: effects act as on a machine that has settled under its covariates.

    Attributes:
        mechanism: the nominal one, frames fitted.
        covariates: names of the columns that come with the joints.
        acting: effects with their numbers; their own code runs on the fields.
        fields: what the effects see of the nominal machine.
        gravity: `3` [m/s²].
        numbers: of every effect by name and coefficient, for the model's card.
        travel: as of `Situation`.
    """

    gravity: Tensor

    def __init__(
        self,
        mechanism: Mechanism,
        gravity: Tensor,
        covariates: Sequence[str],
        acting: Sequence[Acting],
        fields: Fields,
        numbers: Mapping[str, Mapping[str, float]],
        travel: Tensor | None,
    ) -> None:
        super().__init__()
        self.travel = travel
        # In a tuple, since the mechanism's own buffers are no part of the model.
        self._mechanism = (mechanism,)
        self.covariates = list(covariates)
        self.fields = fields
        self.numbers = {name: dict(values) for name, values in numbers.items()}
        self.register_buffer("gravity", gravity.detach().clone())
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

    def changes(self, joints: Tensor, covariates: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """What the effects add to joints `... x n` and to position and rotation vector `... x c` [SI]; None for none.

        Where the machine has no pose, its derivatives are out of all proportion, and they add 0.

        Args:
            joints: commanded, `... x n` [SI].
            covariates: `... x m` [SI].
        """
        here, found = self._situation(joints, covariates), dict[str, Tensor]()
        for one in self.acting:
            change, kind = one.change(here), one.effect.kind
            found[kind] = found[kind] + change if kind in found else change
        # A comparison with NaN is false.
        found = {
            kind: torch.where(change.abs().amax(-1, keepdim=True) <= _MOST, change, torch.zeros_like(change))
            for kind, change in found.items()
        }
        moved, shift = (found.get(kind) for kind in ("joints", "pose"))
        lead = joints.shape[:-1]
        return (
            None if moved is None else moved.reshape(*lead, -1),
            None if shift is None else shift.reshape(*lead, -1),
        )

    def _situation(self, joints: Tensor, covariates: Tensor) -> Situation:
        rows = joints.reshape(-1, joints.shape[-1])
        columns = covariates.reshape(-1, covariates.shape[-1]) if self.covariates else covariates
        given = {name: columns[:, i] for i, name in enumerate(self.covariates) if name != "time"}
        return self.fields.fill(Situation(self._mechanism[0], rows, given, self.gravity, travel=self.travel))

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the tensors are stored beside it."""
        return {
            "mechanism": self._mechanism[0].describe(),
            "covariates": self.covariates,
            "acting": [[one.effect.name, len(one.shape), len(one.coefficients)] for one in self.acting],
            "fields": self.fields.describe(),
            "numbers": self.numbers,
            "travel": None if self.travel is None else self.travel.tolist(),
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> PhysicalEffects:
        """The module as it was described, its tensors 0."""
        # The reader of the file that contains this decides whether code may run.
        mechanism = mechanism_from_description(description["mechanism"], allow_code=True)
        acting = [
            Acting(make_effect(name), *(torch.zeros(size, dtype=torch.float64) for size in sizes))
            for name, *sizes in description["acting"]
        ]
        # Files of before have none.
        travel = description.get("travel")
        return cls(
            mechanism,
            torch.zeros(3, dtype=torch.float64),
            description["covariates"],
            acting,
            Fields.from_description(description["fields"], mechanism),
            description["numbers"],
            None if travel is None else torch.tensor(travel, dtype=torch.float64).reshape(2, len(mechanism.joints)),
        )


def expand_effects(
    situation: Situation,
    acting: Sequence[Acting],
    covariates: Sequence[str],
    margin: float,
) -> PhysicalEffects:
    """Effects with their numbers as a module that a model file can hold.

    Args:
        situation: the training rows, `s x n`; of its parameters the nominal ones are taken.
        acting: effects of the library, without time.
        covariates: names of the compensator's covariates, in order.
        margin: of the compensator's domain.

    Raises:
        InputError, MethodFailedError: what the effects see of the machine cannot be expanded over these joints.
    """
    mechanism, few = situation.mechanism, slice(0, 8)
    given = {name: value[few] for name, value in situation.covariates.items()}
    names: set[str] = set()
    for one in acting:
        names |= looked_at(Situation(mechanism, situation.joints[few], given, situation.gravity), one.change)
    fields = make_fields(mechanism, situation.gravity, names, situation.joints, margin)
    numbers: dict[str, dict[str, float]] = {}
    for label, one in labelled(acting):
        named = [c.name for c in one.effect.coefficients(situation)] + [s.name for s in one.effect.shapes(situation)]
        values = [*one.coefficients.tolist(), *one.shape.tolist()]
        numbers[label] = dict(zip(named, values, strict=True))
    module = PhysicalEffects(mechanism, situation.gravity, covariates, acting, fields, numbers, situation.travel)
    module.requires_grad_(False)
    # Effects that ask which of their columns the workspace shows keep the answer; a traced graph could not ask.
    columns = [given.get(name, torch.zeros_like(situation.joints[few, 0])) for name in module.covariates]
    module.changes(situation.joints[few], torch.stack(columns, -1) if columns else situation.joints[few, :0])
    return module
