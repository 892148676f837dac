"""Checkpoints: tensors in safetensors, written whole or not at all, so that a kill at any moment leaves a good file."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ccnn_torch.errors import InputError

__all__ = ["load_checkpoint", "save_checkpoint", "tensor_digest", "write_whole"]


def write_whole(path: Path, content: bytes) -> None:
    """Write a file through a temporary one beside it; a reader sees the old content or the new, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    with temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, path)


def tensor_digest(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names, types, shapes and bytes; safetensors itself does not notice a flipped byte."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name}|{tensor.dtype}|{tuple(tensor.shape)}|".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def save_checkpoint(path: Path, tensors: dict[str, Tensor], about: dict[str, Any]) -> None:
    """Write tensors (any device) and JSON-able facts about them."""
    held = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    facts = json.dumps({"about": about, "sha256": tensor_digest(held)}, sort_keys=True)
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
    facts = json.loads(metadata.get("ccnn_torch", "{}"))
    if facts.get("sha256") != tensor_digest(tensors):
        raise InputError(
            f"{path}: this checkpoint was altered after it was written; delete it and resume, "
            "which starts its phase again"
        )
    about: dict[str, Any] = facts["about"]
    return tensors, about
