"""The master of a model: its metadata beside its tensors, and the module that is built again from both."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.model_files.metadata import (
    FORMAT,
    METADATA_KEY,
    RUN_ERRORS,
    TAKE_AGAIN,
    Limit,
    coordinates,
    digest_of,
    from_json,
    read_facts,
    said,
)
from ccnn_torch.compensation.networks import describe_network, network_from_description
from ccnn_torch.errors import InputError, ModelFileError, raise_if_out_of_memory
from ccnn_torch.training import Scaling, tensor_digest
from ccnn_torch.version import __version__

OPTIONAL = ("secant", "machine")
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
    facts: dict[str, Any] = {
        "format": FORMAT,
        **{key: fields[key] for key in _REQUIRED},
        "pose": [dict(zip(("name", "unit"), header.rstrip("]").split("["), strict=True)) for header in pose],
        "versions": {"python": platform.python_version(), "ccnn_torch": __version__}
        | {name: version(name) for name in _PACKAGES},
        **description_of(compensator),
    }
    facts["sha256"] = {"tensors": tensor_digest(dict(compensator.state_dict()))}
    facts["sha256"]["keys"] = digest_of(facts)
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
            c.name: {"unit": c.unit, **dict(zip(Limit.model_fields, values, strict=True))}
            for c, *values in zip(compensator.joints, *limits, strict=True)
        },
        "lipschitz": compensator.lipschitz,
        "iterations": compensator.iterations,
        **({"secant": True} if compensator.secant else {}),
        **{name: part.describe() for name, part in parts.items() if part is not None},
    }


def check_tensors(facts: Mapping[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raise ModelFileError unless the tensors are those that the facts were written with."""
    if facts["sha256"]["tensors"] != tensor_digest(tensors):
        raise ModelFileError("its weights were altered after it was written" + TAKE_AGAIN)


def open_master(content: bytes) -> tuple[dict[str, Any], Compensator]:
    """Facts and module.

    Raises:
        ModelFileError: it is no model of ours; without the path.
    """
    try:
        tensors = load_tensors(content)
        # The header's length is in the first eight bytes, the header behind it; load() keeps it to itself.
        header = from_json(content[8 : 8 + int.from_bytes(content[:8], "little")])
    except (SafetensorError, ValueError, KeyError):
        raise ModelFileError("it is damaged, or no safetensors file" + TAKE_AGAIN) from None
    facts = read_facts(header.get("__metadata__", {}).get(METADATA_KEY))
    try:
        check_tensors(facts, tensors)
        compensator = _rebuild(facts, tensors)
        limits = [compensator.limit.tolist(), compensator.most.tolist()]
    except RUN_ERRORS as reason:
        raise_if_out_of_memory(reason)
        raise ModelFileError(
            f"its tensors are not those that its metadata lists ({said(reason)})" + TAKE_AGAIN
        ) from None
    if limits != [[facts["limits"][c["name"]][k] for c in facts["joints"]] for k in ("limit", "most_deviation")]:
        raise ModelFileError("its limits are not those of its metadata" + TAKE_AGAIN)
    return facts, compensator


def _rebuild(facts: Mapping[str, Any], tensors: dict[str, Tensor]) -> Compensator:
    """The module out of its description and tensors."""
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        part, _, rest = name.partition(".")
        parts.setdefault(part, {})[rest] = value

    def made(key: str) -> Any:
        if key not in facts:
            return None
        module = network_from_description(facts[key])
        module.load_state_dict(parts.get(key, {}))
        return module

    return Compensator(
        made("network").requires_grad_(False),
        Scaling(**parts["scaling"]),
        Domain(**parts["domain"]),
        tensors["limit"],
        tensors["safe"],
        coordinates(facts["joints"]),
        coordinates(facts["covariates"]),
        facts["lipschitz"],
        facts["iterations"],
        tensors["sd_scale"],
        tensors["safe_sd"],
        facts.get("secant", False),
        made("machine"),
        tensors["most"],
    )
