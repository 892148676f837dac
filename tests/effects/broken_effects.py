"""Effects as users write them: a good one, and others that break what `ccnn_torch.effects.Effect` says in one point."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects import Coefficient, Kind, Shape, Situation
from ccnn_torch.mechanisms import Mechanism

GRID = (0.5, 1.0, 2.0)


class Good:
    """Δq = c |q|^power."""

    name = "good"
    kind: Kind = "joints"
    description = "a power of the joint"
    ordered = False
    unit, scale, joint, leg = "rad", 1e-3, None, None

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        joints = situation.mechanism.joints
        return tuple(Coefficient(j.name, self.unit, self.scale, self.joint, self.leg) for j in joints)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1", GRID),)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return torch.diag_embed(situation.joints.abs() ** shape.unsqueeze(-2))


class Wide(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape)[..., :1]


class OneSet(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return torch.diag_embed(situation.joints.abs() ** shape.flatten()[0])


class Raises(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return torch.ones(3) @ torch.ones(4)  # the line that a sentence names


class OwnError(Exception):
    """As users derive their own."""


class RaisesOwn(Good):
    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        raise OwnError("no table for this machine")


class Unsaid(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape) * situation.covariates["pressure"][:, None, None]


class Numpy(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape).numpy()  # type: ignore[return-value]


class NaN(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape) * torch.nan


class SomeNaN(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        basis = super().basis(situation, shape)
        basis[..., 3, :, :] = torch.where(shape[..., :1] == GRID[-1], torch.inf, basis[..., 3, 0, :1])[..., None]
        return basis


class Single(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape).float()


class Late(Good):
    """Fails only between the values of its grid, where a search comes late."""

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        return super().basis(situation, shape) * {value: 1.0 for value in GRID}[float(shape.flatten()[0])]


class LateNaN(Good):
    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        between = (shape[..., None] - torch.tensor(GRID, dtype=torch.float64)).abs().amin(-1) > 1e-6
        return super().basis(situation, shape) + torch.where(between, torch.nan, 0.0)[..., None, None]


class NoGrid(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1", ()),)


class Falling(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1", GRID[::-1]),)


class TensorGrid(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1", torch.linspace(0.5, 2.0, 4)),)  # type: ignore[arg-type]


class OutOfRange(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1", GRID, columns=(0, 2)),)


class NoComma(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return Shape("power", "1", GRID)  # type: ignore[return-value]


class ShapesFail(Good):
    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        return (Shape("power", "1"),)  # type: ignore[call-arg]


class OneTooMany(Good):
    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        return (*super().coefficients(situation), Coefficient("more", "rad", 1e-3))


class Twice(Good):
    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        return tuple(Coefficient("same", "rad", 1e-3) for _ in situation.mechanism.joints)


class NoCoefficient(Good):
    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        return ()


class Pairs(Good):
    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        return (("q1", 1e-3), ("q2", 1e-3))  # type: ignore[return-value]


class Silent(Good):
    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        return None  # type: ignore[return-value]


class ScaleZero(Good):
    scale = 0.0


class ScaleNegative(Good):
    scale = -1e-3


class ScaleNaN(Good):
    scale = float("nan")


class BadUnit(Good):
    unit = "radd/N/m"


class NotSI(Good):
    unit = "mrad"


class NoSuchJoint(Good):
    joint = "q7"  # type: ignore[assignment]


class NoSuchLeg(Good):
    leg = 9  # type: ignore[assignment]


class Named(Good):
    name = "backlash"


class Outlier(Good):
    name = "outlier"


class Nameless(Good):
    name = " "


class Needs(Good):
    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness


class NeedsFile(Good):
    def __init__(self) -> None:
        with open("no/such/table.csv", encoding="utf-8") as file:
            self.table = file.read()


class LaterColumn(Good):
    """Asks for a column, and fails as soon as it is there."""

    name = "later column"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        return "" if "temperature" in covariates else "the temperature: temperature[degC]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        raise OwnError("nobody ever came here")
