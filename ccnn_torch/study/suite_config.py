"""The config of a suite: a base and the cases that differ from it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.config.tree import apply_overrides, resolve_paths, validated
from ccnn_torch.engine import Engine
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.study.runs import Study

# Keys of the suite itself, where they come from the command line.
_OWN = ("name", "out", "engine")

# Both take longer than many cases; a suite is for the comparison.
_DEFAULTS = {"save_models": False, "save_report": False}


class SuiteFile(BaseModel):
    """The form of a suite's file."""

    model_config = ConfigDict(extra="forbid", frozen=True, coerce_numbers_to_str=True)

    name: str = Field(default="suite", min_length=1, description="name of the suite; default: the file's name")
    out: str | None = Field(default=None, description="folder to write; default runs/NAME")
    engine: Engine = Field(
        default="local", description="where the cases run: local, processes, dask, or a scheduler as tcp://HOST:8786"
    )
    base: dict[str, Any] = Field(default_factory=dict, description="keys that all cases share, as in a config of a run")
    cases: list[dict[str, Any]] = Field(
        default=[],
        validate_default=True,
        min_length=1,
        description="a name each, and the keys in which it differs from base",
    )


def load_suite(path: str | Path, overrides: Iterable[str] = ()) -> Study:
    """Read a suite's file and put overrides over every case.

    A case is `base` with the case's keys over it (sections are merged, lists replaced), then the overrides. `name=…`
    and `out=…` are those of the suite. Model files, plots and reports of the cases are not written unless the keys
    `save_models: true`, `save_report: true` say so.

    Raises:
        InputError: the file, a case or an override cannot be used; names the case.
    """
    path = Path(path)
    tree = read_yaml(path)
    tree.setdefault("name", path.stem)
    resolve_paths(tree, Path(os.path.realpath(path.parent)))
    overrides = list(overrides)
    own = [text for text in overrides if text.partition("=")[0].strip() in _OWN]
    given = apply_overrides(tree, own, Path.cwd())
    file = validated(SuiteFile, tree, str(path), given)
    out = Path(file.out) if file.out else Path("runs") / file.name
    others = [text for text in overrides if text not in own]
    cases: dict[str, RunConfig] = {}
    for number, keys in enumerate(file.cases, 1):
        name = _name(keys, f"{path}: case {number}", cases)
        case = _merged(_DEFAULTS, _merged(file.base, keys)) | {"name": name}
        resolve_paths(case, Path(os.path.realpath(path.parent)))
        changed = apply_overrides(case, others, Path.cwd())
        cases[name] = validated(RunConfig, case | {"out": str(out / name)}, f"{path}, case '{name}'", changed)
    return Study(file.name, out, cases, file.engine)


def _name(keys: Mapping[str, Any], where: str, taken: Iterable[str]) -> str:
    name = keys.get("name")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][\w.-]*", name):
        raise InputError(f"{where}: name: must be letters, digits, '-', '_' and '.', it names a folder; not {name!r}")
    if name in taken:
        raise InputError(f"{where}: name: '{name}' is given twice; give each case its own")
    return name


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """One tree over another: sections are merged, all else is replaced."""
    tree = deepcopy(dict(base))
    for key, value in over.items():
        below = tree.get(key)
        both = isinstance(below, dict) and isinstance(value, dict)
        tree[key] = _merged(below, value) if both else deepcopy(value)  # type: ignore[arg-type]
    return tree
