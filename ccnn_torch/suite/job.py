"""`ccnn suite`: many runs from one config, each an ordinary run folder, and a comparison of all methods over them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ccnn_torch.calibration.calibrate import makers
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN
from ccnn_torch.engine import Job, run_jobs
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.write import sweep
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, locked, resume_hint
from ccnn_torch.suite.config import Suite
from ccnn_torch.suite.page import compare, write_suite
from ccnn_torch.suite.tables import case_line, print_suite


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
        check_folder(config)
    with locked(suite.out):
        # The cases have locks of their own.
        sweep(suite.out, below=False)
        return _run_cases(suite, quiet)


def finish_cases(
    cases: Mapping[str, RunConfig], engine: str, quiet: bool
) -> tuple[dict[str, Mapping[str, Any]], dict[str, str]]:
    """Results of the cases, and a sentence for each whose methods all failed.

    Raises:
        InputError: a case cannot be run; the others are finished by then.
        MethodFailedError: not a single case could be run.
    """
    here = engine == "local"
    # On a cluster, and in another process, paths that start here mean nothing.
    configs = {name: c.model_copy(update={"out": os.path.abspath(str(c.out))}) for name, c in cases.items()}
    jobs = [
        Job(name, RunFolder(Path(str(config.out))).results, partial(_finish, config, quiet or not here))
        for name, config in configs.items()
    ]
    failed = run_jobs(jobs, engine, partial(note, quiet=quiet))
    for name, problem in failed.items():
        if problem.input:
            raise InputError(f"case '{name}': {problem.text}")
    if len(failed) == len(cases):
        raise MethodFailedError("; ".join(f"case '{name}': {problem.text}" for name, problem in failed.items()))
    results: dict[str, Mapping[str, Any]] = {job.name: read_json(job.result) for job in jobs if job.name not in failed}
    return results, {name: problem.text for name, problem in failed.items()}


def _run_cases(suite: Suite, quiet: bool) -> Path:
    results, failed = finish_cases(suite.cases, suite.engine, quiet)
    about = {name: _about(config) for name, config in suite.cases.items()}
    comparison = compare(suite.name, results, about, failed)
    if not quiet:
        print_suite(comparison, stdout)
    with resume_hint("the same command"):
        path = write_suite(suite.out, comparison)
    if not quiet:
        say_place(f"Everything is in {suite.out}")
    return path


def _finish(config: RunConfig, quiet: bool) -> str:
    """Resume or start the run of a case; returns a line about its errors."""
    return case_line(read_json(RUN.finish(config, quiet=quiet, tables=False).results))


def check_folder(config: RunConfig) -> None:
    """Refuse the folder of a case that was run with other keys."""
    assert config.out is not None
    folder = RunFolder(Path(config.out))
    if not folder.config.is_file():
        return
    there, wanted = (_comparable(c) for c in (RunConfig.from_file(folder.config), config))
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
