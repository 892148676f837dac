"""Metadata of a model file: one JSON text, the same in the master and in every export."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

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
_LIMITS = ("limit", "most_deviation", "safe_correction", "safe_sd", "sd_scale")
OPTIONAL = ("secant", "geometry", "effects", "machine")
"""Keys of parts that not every model has."""
_REQUIRED = ("mechanism", "metrics", "data_sha256", "seed")
_PACKAGES = ("torch", "onnx", "onnxruntime", "safetensors", "numpy")


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
    about = (compensator.limit, compensator.most, compensator.safe, compensator.safe_sd, compensator.sd_scale)
    limits = (v.tolist() for v in about)
    facts: dict[str, Any] = {
        "format": FORMAT,
        **{key: fields[key] for key in _REQUIRED},
        "joints": [_plain(c) for c in compensator.joints],
        "covariates": [_plain(c) for c in compensator.covariates],
        "pose": [dict(zip(("name", "unit"), header.rstrip("]").split("["), strict=True)) for header in pose],
        "network": describe_network(compensator.network),
        "domain": compensator.domain.describe(compensator.joints + compensator.covariates),
        "limits": {
            c.name: {"unit": c.unit, **dict(zip(_LIMITS, values, strict=True))}
            for c, *values in zip(compensator.joints, *limits, strict=True)
        },
        "lipschitz": compensator.lipschitz,
        "iterations": compensator.iterations,
        "versions": {"python": platform.python_version(), "ccnn_torch": __version__}
        | {name: version(name) for name in _PACKAGES},
    }
    if compensator.secant:
        facts["secant"] = True
    for name in OPTIONAL[1:]:
        part = getattr(compensator, name)
        if part is not None:
            facts[name] = part.describe()
    facts["sha256"] = {"tensors": tensor_digest(dict(compensator.state_dict()))}
    facts["sha256"]["keys"] = _digest(facts)
    return facts


def check_keys(facts: Any) -> dict[str, Any]:
    """The facts, when they are ours and unchanged.

    Raises:
        ModelFileError: they are not.
    """
    written = str(facts.get("format")) if isinstance(facts, dict) else ""
    known = written == FORMAT
    if not known and written.startswith(_FORMATS):
        raise ModelFileError(
            f"it has the form '{written}' of another version of this package, which reads {FORMAT!r}; write it again "
            "with this version (ccnn run …, or save_model)"
        )
    if not isinstance(facts, dict) or not known:
        raise ModelFileError(
            f"its metadata does not have the form '{FORMAT}', so this package did not write it" + TAKE_AGAIN
        )
    stated = facts.get("sha256")
    if not isinstance(stated, dict) or stated.get("keys") != _digest(facts):
        raise ModelFileError("its metadata was edited after it was written" + TAKE_AGAIN)
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


def _plain(coordinate: Coordinate) -> dict[str, str]:
    return {"name": coordinate.name, "unit": coordinate.unit}
