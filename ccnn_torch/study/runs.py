"""A study: many runs, each an ordinary run folder, and what is written about all of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

from ccnn_torch.calibration.calibrate import makers
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN
from ccnn_torch.calibration.page import errors_line
from ccnn_torch.engine import Job, run_jobs
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.write import sweep
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.screen import note
from ccnn_torch.run_folder.folder import RunFolder, locked, resume_hint

_Written = TypeVar("_Written")


@dataclass(frozen=True)
class Study:
    """Many runs, checked.

    Attributes:
        runs: configs by name, in order; each writes `out / name`.
        keys: of a sweep the keys that vary, in order.
        values: of a sweep the values of these keys as they were written, by the run's name.
    """

    name: str
    out: Path
    runs: dict[str, RunConfig]
    engine: str = "local"
    keys: tuple[str, ...] = ()
    values: dict[str, tuple[str, ...]] = field(default_factory=dict)


Write = Callable[[Study, Mapping[str, RunResults], Mapping[str, str]], _Written]
"""Writes the comparison of all runs: results by name, and a sentence for each run whose methods all failed."""


def run_study(study: Study, write: Write[_Written], quiet: bool = False) -> _Written:
    """Run what is not finished yet, and write their comparison; a second call keeps finished runs.

    Raises:
        InputError: a run cannot start, its folder holds another run, or the folder is in use; the others are finished.
        MethodFailedError: not a single run has results.
    """
    for config in study.runs.values():
        makers(config)
        _check_folder(config)
    with locked(study.out):
        # The runs have locks of their own.
        sweep(study.out, below=False)
        # Of several processes only one may draw bars. On a cluster paths that start here mean nothing.
        alone, jobs = quiet or study.engine != "local", []
        for name, config in study.runs.items():
            folder = RunFolder(Path(os.path.abspath(str(config.out))))
            call = partial(_finish, config.model_copy(update={"out": str(folder.path)}), alone)
            jobs.append(Job(name, folder.results, call))
        failed = run_jobs(jobs, study.engine, partial(note, quiet=quiet))
        for name, problem in failed.items():
            if problem.input:
                raise InputError(f"case '{name}': {problem.text}")
        if len(failed) == len(study.runs):
            raise MethodFailedError("; ".join(f"case '{name}': {problem.text}" for name, problem in failed.items()))
        results = {
            name: RunResults.read(RunFolder(Path(str(config.out))).results)
            for name, config in study.runs.items()
            if name not in failed
        }
        with resume_hint("the same command"):
            return write(study, results, {name: problem.text for name, problem in failed.items()})


def _finish(config: RunConfig, quiet: bool) -> str:
    """Start or resume a run without its tables; returns a line about the errors of its methods."""
    return errors_line(RunResults.read(RUN.finish(config, quiet, details=None).results))


def _check_folder(config: RunConfig) -> None:
    """Refuse the folder of a run with other keys; it may have been moved."""
    folder = RunFolder(Path(str(config.out)))
    if not folder.config.is_file():
        return
    there, wanted = (c.model_dump(mode="json", exclude={"out"}) for c in (RunConfig.from_file(folder.config), config))
    other = sorted(key for key in wanted if there[key] != wanted[key])
    if other:
        raise InputError(
            f"{folder.path} holds a run that differs in {', '.join(other)}; give another folder with --out, or remove "
            "that one"
        )
