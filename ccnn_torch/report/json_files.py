"""JSON result files: written atomically, without NaN, and each with a JSON Schema."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import parse_json, read_text
from ccnn_torch.files.write import write_whole

# Results with all their repeats have some MB.
_LARGEST = 500_000_000


def plain(value: Any) -> Any:
    """The same value in JSON's types: arrays and tensors become lists, numbers that are not finite become None.

    Raises:
        TypeError: a value that JSON has no form for.
    """
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, torch.Tensor):
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


def write_json(path: str | Path, value: Mapping[str, Any]) -> None:
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


def load_schema(name: str) -> dict[str, Any]:
    """A JSON Schema (draft 2020-12) of this package.

    Args:
        name: `results`, `identified`, `suite`, `diagnosis`, `card` or `verify`.
    """
    text = files("ccnn_torch.report").joinpath(f"{name}.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema
