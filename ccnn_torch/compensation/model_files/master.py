"""From the bytes of a model file to its metadata and a way to run it; nothing in it runs as code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import onnx
import torch
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from torch import Tensor

from ccnn_torch.compensation.compensator import Compensator
from ccnn_torch.compensation.domain import Domain
from ccnn_torch.compensation.model_files.metadata import check_tensors, coordinates, from_json, read_facts
from ccnn_torch.compensation.model_files.onnx_session import (
    METADATA_KEY,
    OUTPUTS,
    RUN_ERRORS,
    TAKE_AGAIN,
    Array,
    check_graph,
    open_onnx,
    run_onnx,
    said,
)
from ccnn_torch.compensation.networks import network_from_description
from ccnn_torch.errors import ModelFileError, raise_if_out_of_memory
from ccnn_torch.training import Scaling

Run = Callable[[Array, Array | None], dict[str, Array]]


def open_model(path: Path, content: bytes) -> tuple[dict[str, Any], Run, Compensator | None]:
    """Facts, a way to run it, and the module where there is one; by what the name ends in.

    Raises:
        ModelFileError: it is no model of ours; without the path.
    """
    if path.suffix == ".safetensors":
        facts, compensator = _open_master(content)
        return facts, lambda joints, covariates: _run_module(compensator, joints, covariates), compensator
    facts, session = _open_onnx(content)
    return facts, lambda joints, covariates: run_onnx(session, joints, covariates), None


def _open_master(content: bytes) -> tuple[dict[str, Any], Compensator]:
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


def _open_onnx(content: bytes) -> tuple[dict[str, Any], Any]:
    try:
        model = onnx.load_from_string(content)
    except DecodeError:
        raise ModelFileError("it is damaged, or no ONNX file" + TAKE_AGAIN) from None
    facts = read_facts({entry.key: entry.value for entry in model.metadata_props}.get(METADATA_KEY))
    if any(i.type.tensor_type.elem_type == onnx.TensorProto.FLOAT for i in model.graph.input):
        raise ModelFileError(
            "this is the single precision variant for controllers, which gives one row's deviation; use the .onnx "
            "file without 'float32' in its name"
        )
    check_graph(model)
    inputs = ["joints", "covariates"] if facts["covariates"] else ["joints"]
    if [i.name for i in model.graph.input] != inputs or not {*OUTPUTS} <= {o.name for o in model.graph.output}:
        raise ModelFileError(f"its graph does not take {', '.join(inputs)} and give {', '.join(OUTPUTS)}" + TAKE_AGAIN)
    try:
        return facts, open_onnx(content)
    except RUN_ERRORS as reason:
        raise_if_out_of_memory(reason)
        raise ModelFileError(f"ONNX Runtime does not take its graph ({said(reason)})" + TAKE_AGAIN) from None


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
        made("geometry"),
        made("effects"),
        facts.get("secant", False),
        made("machine"),
        tensors["most"],
    )


def _run_module(compensator: Compensator, joints: Array, covariates: Array | None) -> dict[str, Array]:
    given = [torch.tensor(v) for v in (joints, covariates) if v is not None]
    with torch.no_grad():
        return {name: value.numpy() for name, value in compensator.solve(*given)._asdict().items()}
