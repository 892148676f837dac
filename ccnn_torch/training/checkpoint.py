"""Checkpoints: tensors in safetensors files that are written whole or not at all."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.files.write import write_whole


def tensor_digest(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes; safetensors itself does not notice a flipped byte."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name}|{tensor.dtype}|{tuple(tensor.shape)}|".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def save_checkpoint(path: Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
    """Write tensors (any device) and JSON-able facts about them, all under one hash.

    Raises:
        WriteError: it cannot be written; an older one is as it was.
    """
    held = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    facts = json.dumps({"about": about, "sha256": _seal(held, about)}, sort_keys=True)
    write_whole(path, save(held, metadata={"ccnn_torch": facts}))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_checkpoint` wrote.

    Raises:
        InputError: the file is damaged or is not a checkpoint of this package.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError) as problem:
        raise InputError(
            f"{path}: this checkpoint cannot be read ({problem}); delete it and resume, which starts its phase again"
        ) from None
    try:
        facts = json.loads(metadata["ccnn_torch"])
        about: dict[str, Any] = facts["about"]
        whole = isinstance(about, dict) and facts["sha256"] == _seal(tensors, about)
    except (KeyError, TypeError, ValueError, RecursionError):
        whole = False
    if not whole:
        raise InputError(
            f"{path}: this checkpoint was altered after it was written; delete it and resume, "
            "which starts its phase again"
        )
    return tensors, about


def _seal(tensors: dict[str, Tensor], about: dict[str, Any]) -> str:
    """SHA-256 over the tensors and their metadata."""
    return hashlib.sha256((tensor_digest(tensors) + json.dumps(about, sort_keys=True)).encode()).hexdigest()
