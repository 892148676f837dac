"""The machine that a diagnosis found, as numbers of its file: kinematics, effects, and the region measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects.apply import Acting
from ccnn_torch.effects.registry import EFFECTS, make_effect
from ccnn_torch.effects.situation import Situation
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, mechanism_from_description
from ccnn_torch.units import LARGEST

_Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
_Range = Annotated[list[_Number], Field(min_length=2, max_length=2)]


class _Form(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Effect(_Form):
    name: str
    coefficients: list[_Number]
    shapes: list[_Number]


class _Covariate(_Form):
    unit: str
    range: _Range


class _Block(_Form):
    nominal: dict[str, Any]
    parameters: dict[str, _Number]
    gravity: Annotated[list[_Number], Field(min_length=3, max_length=3)]
    joints: dict[str, _Range]
    covariates: dict[str, _Covariate]
    effects: list[_Effect]
    columns: dict[str, str] = {}
    joint_map: dict[str, str] = {}


class FoundMachine(NamedTuple):
    """A machine, and where it was measured.

    Attributes:
        nominal: with frames fitted.
        values: all parameters as identified, `k` [SI].
        acting: effects on joints and pose.
        gravity: `3` [m/s²].
        joints: lowest and highest, `n x 2` [SI].
        covariates: those without which the effects change.
        edges: lowest and highest of each, `m x 2` [SI].
        columns, joint_map: as the records had them.
        beside: lowest and highest joints of the records, `n x 2` [SI], of a machine that holds all over its workspace,
            which has no `joints`; none where these are not known.
    """

    nominal: Mechanism
    values: Tensor
    acting: list[Acting]
    gravity: Tensor
    joints: Tensor
    covariates: tuple[Coordinate, ...]
    edges: Tensor
    columns: dict[str, str]
    joint_map: dict[str, str]
    beside: Tensor = torch.zeros(0, 2, dtype=torch.float64)

    @property
    def identified(self) -> Mechanism:
        """With the identified parameters as its nominal ones."""
        return self.nominal.with_nominal(self.values)

    @property
    def measured(self) -> Tensor | None:
        """Lowest and highest joints of the records, `n x 2` [SI]; None where they are not known."""
        return next((ends for ends in (self.joints, self.beside) if len(ends)), None)

    @property
    def travel(self) -> Tensor | None:
        """As of `Situation`."""
        return self.joints.mT if len(self.joints) else None

    def rows(self, count: int) -> Situation:
        """Rows all over the region, the same for the same machine.

        Legs of a parallel machine move together: the joints are those of poses of its workspace, stretched to where it
        was measured. Legs that are drawn one by one would turn its platform as no record does.
        """
        generator = torch.Generator().manual_seed(0)
        drawn = self.nominal.sample_joints(count, generator)
        drawn = torch.where(torch.isfinite(drawn), drawn, self.nominal.home_joints)
        low, high = drawn.amin(0), drawn.amax(0)
        share = (drawn - low) / (high - low).clamp_min(torch.finfo(drawn.dtype).tiny)
        joints = self.joints[:, 0] + (self.joints[:, 1] - self.joints[:, 0]) * share
        share = torch.rand(count, len(self.edges), generator=generator, dtype=torch.float64)
        values = self.edges[:, 0] + (self.edges[:, 1] - self.edges[:, 0]) * share
        given = {c.name: values[:, i] for i, c in enumerate(self.covariates)}
        return Situation(self.nominal, joints, given, self.gravity, travel=self.travel)


def found_block(
    rows: Situation,
    values: Tensor,
    acting: Sequence[Acting],
    units: Mapping[str, str],
) -> dict[str, Any]:
    """The entry `machine` of a diagnosis.json.

    Args:
        rows: measured, on the nominal machine with its frames fitted, with the covariates that the effects need.
        values: all parameters as identified, `k` [SI].
        acting: effects of the library.
        units: of the covariates [SI].
    """

    def edges(values: Tensor) -> list[float]:
        return [float(values.min()), float(values.max())]

    mechanism = rows.mechanism
    return {
        "nominal": mechanism.describe(),
        "parameters": dict(zip((p.name for p in mechanism.geometry), values.tolist(), strict=True)),
        "gravity": rows.gravity.tolist(),
        "joints": {j.name: edges(rows.joints[:, i]) for i, j in enumerate(mechanism.joints)},
        "covariates": {name: {"unit": units[name], "range": edges(v)} for name, v in rows.covariates.items()},
        "effects": [
            {"name": a.effect.name, "coefficients": a.coefficients.tolist(), "shapes": a.shape.tolist()} for a in acting
        ],
    }


def machine_of_block(block: Any, path: str, allow_code: bool = False) -> FoundMachine:
    """Inverse of `found_block`, whatever else the file contains.

    Raises:
        InputError: the block is none of ours, or names code that was not allowed.
    """
    try:
        form = _Block.model_validate(block)
        nominal = mechanism_from_description(form.nominal, allow_code)
        values = torch.tensor([form.parameters[p.name] for p in nominal.geometry], dtype=torch.float64)
        joints = torch.tensor([form.joints[j.name] for j in nominal.joints], dtype=torch.float64)
        covariates = tuple(Coordinate(name, c.unit) for name, c in form.covariates.items())
        edges = torch.tensor([c.range for c in form.covariates.values()], dtype=torch.float64).reshape(-1, 2)
        gravity = torch.tensor(form.gravity, dtype=torch.float64)
        found = FoundMachine(nominal, values, [], gravity, joints, covariates, edges, form.columns, form.joint_map)
        return found._replace(acting=[_acting(one, found.rows(2)) for one in form.effects])
    except InputError as reason:
        raise InputError(f"{path}: machine: {reason}") from None
    except (ValidationError, KeyError, ValueError) as reason:
        what = reason.errors()[0]["loc"] if isinstance(reason, ValidationError) else (reason,)
        raise InputError(
            f"{path}: machine: is not as ccnn diagnose writes it ({', '.join(map(str, what))}); diagnose again"
        ) from None


def _acting(form: _Effect, rows: Situation) -> Acting:
    """An effect with its numbers; KeyError or ValueError where it is no such effect."""
    if form.name not in EFFECTS:
        raise KeyError(form.name)
    effect = make_effect(form.name)
    numbers = [torch.tensor(v, dtype=torch.float64) for v in (form.shapes, form.coefficients)]
    wanted = (len(effect.shapes(rows)), len(effect.coefficients(rows)))
    if effect.kind == "parameters" or tuple(map(len, numbers)) != wanted:
        raise ValueError(form.name)
    return Acting(effect, *numbers)
