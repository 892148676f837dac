"""JSON result files: written atomically, without NaN."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import parse_json, read_text
from ccnn_torch.files.write import write_whole

# Results with all their repeats have some MB.
_LARGEST = 500_000_000


def plain(value: Any) -> Any:
    """The same value in JSON's types: models become objects, arrays and tensors lists, infinite numbers and NaN None.

    Raises:
        TypeError: a value that JSON has no form for.
    """
    if isinstance(value, BaseModel):
        value = value.model_dump(exclude_unset=True, by_alias=True)
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    # A tensor; torch itself takes a second to load, which commands that only read results need not wait for.
    if hasattr(value, "detach"):
        return plain(value.detach().cpu().numpy())
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"JSON has no form for a {type(value).__name__}.")


def write_json(path: str | Path, value: Mapping[str, Any] | BaseModel) -> None:
    """Write a JSON file; a reader sees the old file or the new one, never half of one."""
    text = json.dumps(plain(value), indent=2, allow_nan=False, ensure_ascii=False)
    write_whole(path, text + "\n")


def read_json(path: str | Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        InputError: there is no such file, or it holds no JSON object.
    """
    value = parse_json(read_text(path, _LARGEST, "give the folder of a finished run"), str(path))
    if not isinstance(value, dict):
        raise InputError(f"{path} must hold one JSON object, not a {type(value).__name__}.")
    return value
