"""Metadata of a model file: one JSON text, the same in the master and in every export, and the form that it has."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.model_files.onnx_session import TAKE_AGAIN
from ccnn_torch.compensation.networks import describe_network
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.training import tensor_digest
from ccnn_torch.version import __version__

_FORMATS = "ccnn_torch compensator "
FORMAT = f"{_FORMATS}6"
OPTIONAL = ("secant", "geometry", "effects", "machine")
"""Keys of parts that not every model has."""
_REQUIRED = ("mechanism", "metrics", "data_sha256", "seed")
_PACKAGES = ("torch", "onnx", "onnxruntime", "safetensors", "numpy")


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


def fingerprint(compensator: Compensator, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Everything a reader of the model needs beside its tensors; equal for equal model and fields.

    Args:
        fields: `mechanism` (its `describe()`), `metrics`, `data_sha256`, `seed`.
    """
    missing = [key for key in _REQUIRED if key not in fields]
    if missing:
        raise InputError(f"a model's fields lack {', '.join(missing)}; needed are {', '.join(_REQUIRED)}")
    mechanism = fields["mechanism"]
    pose = mechanism.get("pose", []) if isinstance(mechanism, Mapping) else []
    facts: dict[str, Any] = {
        "format": FORMAT,
        **{key: fields[key] for key in _REQUIRED},
        "pose": [dict(zip(("name", "unit"), header.rstrip("]").split("["), strict=True)) for header in pose],
        "versions": {"python": platform.python_version(), "ccnn_torch": __version__}
        | {name: version(name) for name in _PACKAGES},
        **description_of(compensator),
    }
    facts["sha256"] = {"tensors": tensor_digest(dict(compensator.state_dict()))}
    facts["sha256"]["keys"] = _digest(facts)
    return facts


def description_of(compensator: Compensator) -> dict[str, Any]:
    """What the metadata says of the compensator itself."""
    about = (compensator.limit, compensator.most, compensator.safe, compensator.safe_sd, compensator.sd_scale)
    limits = (v.tolist() for v in about)
    parts = {name: getattr(compensator, name) for name in OPTIONAL[1:]}
    return {
        "joints": [{"name": c.name, "unit": c.unit} for c in compensator.joints],
        "covariates": [{"name": c.name, "unit": c.unit} for c in compensator.covariates],
        "network": describe_network(compensator.network),
        "domain": compensator.domain.describe(compensator.joints + compensator.covariates),
        "limits": {
            c.name: {"unit": c.unit, **dict(zip(_Limit.model_fields, values, strict=True))}
            for c, *values in zip(compensator.joints, *limits, strict=True)
        },
        "lipschitz": compensator.lipschitz,
        "iterations": compensator.iterations,
        **({"secant": True} if compensator.secant else {}),
        **{name: part.describe() for name, part in parts.items() if part is not None},
    }


def read_facts(text: Any) -> dict[str, Any]:
    """The facts in a file's metadata, when they are ours, unchanged, and of the form that is used later.

    Raises:
        ModelFileError: they are not; with the key that is missing, no finite number, or does not fit the rest.
    """
    try:
        facts = from_json(text or "null")
    except ValueError:
        raise ModelFileError("its metadata is not JSON" + TAKE_AGAIN) from None
    written = str(facts.get("format")) if isinstance(facts, dict) else ""
    if written != FORMAT and written.startswith(_FORMATS):
        raise ModelFileError(
            f"it has the form '{written}' of another version of this package, which reads {FORMAT!r}; write it again "
            "with this version (ccnn run …, or save_model)"
        )
    if not isinstance(facts, dict) or written != FORMAT:
        raise ModelFileError(
            f"its metadata does not have the form '{FORMAT}', so this package did not write it" + TAKE_AGAIN
        )
    stated = facts.get("sha256")
    if not isinstance(stated, dict) or stated.get("keys") != _digest(facts):
        raise ModelFileError("its metadata was edited after it was written" + TAKE_AGAIN)
    # Two texts can mean one number (long decimals do), so the text itself must be the one we would write.
    if to_json(facts) != text:
        raise ModelFileError("its metadata was edited after it was written")
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
    return facts


def check_tensors(facts: Mapping[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raise ModelFileError unless the tensors are those that the facts were written with."""
    if facts["sha256"]["tensors"] != tensor_digest(tensors):
        raise ModelFileError("its weights were altered after it was written" + TAKE_AGAIN)


def coordinates(entries: list[dict[str, str]]) -> tuple[Coordinate, ...]:
    """Inverse of how coordinates are written in the metadata."""
    return tuple(Coordinate(entry["name"], entry["unit"]) for entry in entries)


def to_json(value: Mapping[str, Any], indent: int | None = None) -> str:
    """Sorted JSON without NaN, which UTF-8 can hold."""
    try:
        text = json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False, indent=indent)
        text.encode()
    except (TypeError, ValueError) as problem:
        raise InputError(f"a model's fields must be JSON: {problem}") from None
    return text


def from_json(text: str | bytes) -> Any:
    """JSON of a file from outside.

    Raises:
        ValueError: it is none, holds NaN or infinity, or is nested without end.
    """

    def no_number(word: str) -> None:
        raise ValueError(f"{word} is no number")

    try:
        return json.loads(text, parse_constant=no_number)
    except RecursionError:
        raise ValueError("is nested too deeply") from None


def _digest(facts: Mapping[str, Any]) -> str:
    """SHA-256 of everything but itself; that of the tensors is among it."""
    others = {key: value for key, value in facts["sha256"].items() if key != "keys"}
    return hashlib.sha256(to_json({**facts, "sha256": others}).encode()).hexdigest()
