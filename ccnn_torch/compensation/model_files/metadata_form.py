"""The form of a model file's metadata: every number that is used later is there, and finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ccnn_torch.compensation.model_files.onnx_session import TAKE_AGAIN
from ccnn_torch.errors import ModelFileError

# No model that can be solved for needs as many; a forged one may not compute for ever.
_MOST_ITERATIONS = 10_000
_MOST_TERMS = 100
# Nor has an effect of the library as many numbers on any machine.
_MOST_NUMBERS = 10_000

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Size = Annotated[float, Field(allow_inf_nan=False, ge=0)]
_Scale = Annotated[float, Field(allow_inf_nan=False, gt=0)]


class _Form(BaseModel):
    # Other keys are for others.
    model_config = ConfigDict(strict=True, extra="ignore")


class _Coordinate(_Form):
    name: str
    unit: str


class _Mechanism(_Form):
    name: str = ""
    joints: list[str] = []
    pose: list[str] = []
    parameters: dict[str, _Number] = {}


class _Limit(_Form):
    limit: _Size
    most_deviation: _Size
    safe_correction: _Number
    safe_sd: _Size
    sd_scale: _Size


class _Edge(_Form):
    low: _Number
    high: _Number


class _Principal(_Form):
    centre: list[_Number]
    half_range: list[_Scale]
    directions: list[list[_Number]]
    low: list[_Number]
    high: list[_Number]


class _Domain(_Form):
    inputs: dict[str, _Edge]
    principal: _Principal


class _Effects(_Form):
    # Name, number of shapes, number of coefficients of each.
    acting: list[list[str | Annotated[int, Field(ge=0, le=_MOST_NUMBERS)]]] = []


class _Machine(_Form):
    degree: Annotated[int, Field(ge=0, le=_MOST_TERMS)] = 0
    newton: Annotated[int, Field(ge=0, le=_MOST_TERMS)] = 0
    effects: _Effects | None = None


class _Facts(_Form):
    mechanism: _Mechanism
    joints: Annotated[list[_Coordinate], Field(min_length=1)]
    covariates: list[_Coordinate]
    pose: list[_Coordinate]
    network: dict[str, Any]
    geometry: dict[str, Any] = {}
    effects: _Effects | None = None
    machine: _Machine = _Machine()
    domain: _Domain
    limits: dict[str, _Limit]
    lipschitz: _Size
    iterations: Annotated[int, Field(ge=0, le=_MOST_ITERATIONS)]
    secant: bool = False


def check_form(facts: Mapping[str, Any]) -> None:
    """Raise ModelFileError, with the key, where something is missing, is no finite number, or does not fit the rest."""
    try:
        form = _Facts.model_validate(facts)
    except ValidationError as problem:
        first = problem.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ModelFileError(f"its card or text has '{key}' wrong ({first['msg']})" + TAKE_AGAIN) from None
    joints = [c.name for c in form.joints]
    inputs = [*joints, *(c.name for c in form.covariates)]
    principal, d = form.domain.principal, len(inputs)
    right = {
        "joints": len({*inputs}) == d,
        # In another order in JSON, where keys are sorted.
        "limits": {*form.limits} == {*joints},
        "domain.inputs": {*form.domain.inputs} == {*inputs},
        "domain.principal": all(len(v) == d for v in (principal.centre, principal.half_range, *principal.directions))
        and len(principal.directions) == len(principal.low) == len(principal.high),
    }
    for key, good in right.items():
        if not good:
            raise ModelFileError(f"its card or text has '{key}' wrong (it does not fit the joints)" + TAKE_AGAIN)
