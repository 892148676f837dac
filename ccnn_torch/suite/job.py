"""`ccnn suite`: many runs from one config, each an ordinary run folder, and a comparison of all methods over them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.calibration.calibrate import makers
from ccnn_torch.calibration.config import RunConfig, load_config
from ccnn_torch.calibration.job import resume_run, start_run
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.write import sweep
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, kept_for
from ccnn_torch.run_folder.lock import locked
from ccnn_torch.suite.config import Suite
from ccnn_torch.suite.page import compare, write_suite
from ccnn_torch.suite.tables import case_line, print_suite

__all__ = ["run_suite"]


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
    """The finished run of a case: kept, resumed, or started."""
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
    # The folder may have been moved, and screen output changes no result.
    return {key: value for key, value in tree.items() if key != "out"}


def _about(config: RunConfig) -> dict[str, Any]:
    """What the comparison states about a case besides its results."""
    about: dict[str, Any] = {"split": config.split.kind}
    if config.case == "realistic":
        about |= config.realistic.model_dump(mode="json")
    return about
