"""`ccnn suite`: many runs from one config, each an ordinary run folder, and a comparison of all methods over them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from ccnn_torch.calibration.calibrate import makers
from ccnn_torch.calibration.config import RunConfig, load_config
from ccnn_torch.calibration.job import resume_run, start_run
from ccnn_torch.config.overrides import apply_overrides, resolve_paths
from ccnn_torch.config.tree import validated
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.write import sweep
from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, kept_for
from ccnn_torch.run_folder.lock import locked
from ccnn_torch.suite.page import compare, write_suite
from ccnn_torch.suite.tables import case_line, print_suite

__all__ = ["Suite", "load_suite", "run_suite"]

# Keys of the suite itself, where they come from the command line.
_OWN = ("name", "out")
# Both take longer than many a case, and what a suite is for is the comparison.
_DEFAULTS = {"save_models": False, "save_report": False}


class SuiteFile(BaseModel):
    """The form of a suite's file."""

    model_config = ConfigDict(extra="forbid", frozen=True, coerce_numbers_to_str=True)

    name: str = Field(default="suite", min_length=1, description="name of the suite; default: the file's name")
    out: str | None = Field(default=None, description="folder to write; default runs/NAME")
    base: dict[str, Any] = Field(default_factory=dict, description="keys that all cases share, as in a config of a run")
    cases: list[dict[str, Any]] = Field(
        default=[],
        validate_default=True,
        min_length=1,
        description="a name each, and the keys in which it differs from base",
    )


@dataclass(frozen=True)
class Suite:
    """A suite, checked.

    Attributes:
        cases: configs by name, in order; each writes `out / name`.
    """

    name: str
    out: Path
    cases: dict[str, RunConfig]


def load_suite(path: str | Path, overrides: Iterable[str] = ()) -> Suite:
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
    return Suite(file.name, out, cases)


def run_suite(suite: Suite, quiet: bool = False) -> Path:
    """Run the cases that are not finished yet, then compare the methods over all of them.

    A case in which no method can be trained is reported and left out of the comparison; the next call tries it again.

    Returns:
        The path of `suite.json`.

    Raises:
        InputError: a case cannot be run, its folder holds another run, or the folder is in use.
        MethodFailedError: not a single case could be run.
    """
    for config in suite.cases.values():
        makers(config)
        _check_folder(config)
    with locked(suite.out):
        # The cases have locks of their own.
        sweep(suite.out, below=False)
        return _run_cases(suite, quiet)


def _run_cases(suite: Suite, quiet: bool) -> Path:
    results: dict[str, Mapping[str, Any]] = {}
    failed: dict[str, str] = {}
    for number, (name, config) in enumerate(suite.cases.items(), 1):
        note(f"[{number}/{len(suite.cases)}] {name}", quiet)
        try:
            results[name] = read_json(_finish(config, quiet).results)
        except InputError as problem:
            raise InputError(f"case '{name}': {problem}") from None
        except MethodFailedError as problem:
            failed[name] = str(problem)
            note(f"    {problem}", quiet)
            continue
        note(f"    {case_line(results[name])}", quiet)
    if not results:
        raise MethodFailedError("; ".join(f"case '{name}': {sentence}" for name, sentence in failed.items()))
    about = {name: _about(config) for name, config in suite.cases.items()}
    comparison = compare(suite.name, results, about, failed)
    if not quiet:
        print_suite(comparison, stdout)
    with kept_for("the same command"):
        path = write_suite(suite.out, comparison)
    if not quiet:
        say_place(f"Everything is in {suite.out}")
    return path


def _finish(config: RunConfig, quiet: bool) -> RunFolder:
    """The finished run of a case: kept as it is, gone on with, or started."""
    assert config.out is not None
    folder = RunFolder(Path(config.out))
    if folder.config.is_file():
        return resume_run(folder.path, quiet=quiet, tables=False)
    return start_run(config, quiet=quiet, tables=False)


def _check_folder(config: RunConfig) -> None:
    """Refuse the folder of a case that was run with other keys."""
    assert config.out is not None
    folder = RunFolder(Path(config.out))
    if not folder.config.is_file():
        return
    there, wanted = (_comparable(c) for c in (load_config(folder.config), config))
    other = sorted(key for key in wanted if there[key] != wanted[key])
    if other:
        raise InputError(
            f"{folder.path} holds a run that differs in {', '.join(other)}; give another folder with --out, or remove "
            "that one"
        )


def _comparable(config: RunConfig) -> dict[str, Any]:
    tree = config.model_dump(mode="json")
    # The folder may have been moved, and the screen decides nothing.
    return {key: value for key, value in tree.items() if key != "out"}


def _about(config: RunConfig) -> dict[str, Any]:
    """What the comparison states about a case besides its results."""
    about: dict[str, Any] = {"split": config.split.kind}
    if config.case == "realistic":
        about |= config.realistic.model_dump(mode="json")
    return about


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
