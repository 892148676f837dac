"""`ccnn run`: a config to a finished run folder, and an unfinished folder to a finished one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from ccnn_torch.calibration.blocks import blocks_of, write_blocks
from ccnn_torch.calibration.calibrate import Calibration, calibrate, makers
from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.calibration.learning.fitting import check_storable
from ccnn_torch.calibration.learning.progress import HeldOut, ProgressBar
from ccnn_torch.calibration.outputs import write_outputs
from ccnn_torch.calibration.page.tables import errors_line, run_page
from ccnn_torch.calibration.page.tensorboard import TensorBoardCallback
from ccnn_torch.calibration.result import plan_of
from ccnn_torch.calibration.rows.prepare import Prepared, TooManyRepeatsError, prepare
from ccnn_torch.calibration.statistics import share_unit
from ccnn_torch.engine import Failure, Job, run_jobs
from ccnn_torch.errors import InputError, MethodFailedError, WriteError
from ccnn_torch.plugins import is_plugin
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, resume_hint
from ccnn_torch.run_folder.resume import FolderJob, check_fingerprint, fingerprint
from ccnn_torch.training import Callback, Scaling, past_of


def _check(config: RunConfig) -> None:
    """Make the learners, and look whether the networks of a user's own can be stored, before anything is computed."""
    learners = makers(config)
    for spec in filter(is_plugin, method_names(config)):
        make = learners[spec.rpartition(":")[2]]
        if config.save_models and make is not None:
            check_storable(spec, make())


def _prepared(config: RunConfig) -> tuple[RunConfig, Prepared | None]:
    """The rows of a run; None where its repeats run in blocks, as the config then says."""
    _check(config)
    if config.block is None and config.engine != "local" and config.repeats > 1:
        config = config.model_copy(update={"block": 1})
    if config.block is not None and config.repeats > 1:
        return config, None
    try:
        return config, prepare(config)
    except TooManyRepeatsError as found:
        return config.model_copy(update={"block": found.block, "max_bytes": found.limit}), None


def finish_runs(runs: Mapping[str, RunConfig], engine: str, quiet: bool) -> dict[str, Failure]:
    """Start or resume many runs, each an ordinary run folder; those that failed, by name."""
    # Of several processes only one may draw bars. On a cluster paths that start here mean nothing.
    alone = quiet or engine != "local"
    jobs = []
    for name, config in runs.items():
        folder = RunFolder(Path(os.path.abspath(str(config.out))))
        call = partial(_finish, config.model_copy(update={"out": str(folder.path)}), alone)
        jobs.append(Job(name, folder.results, call))
    return run_jobs(jobs, engine, partial(note, quiet=quiet))


def _finish(config: RunConfig, quiet: bool) -> str:
    """Start or resume a run without its tables; returns a line about the errors of its methods."""
    return errors_line(RunResults.read(RUN.finish(config, quiet, tables=False).results))


def _run_blocks(config: RunConfig, folder: RunFolder, quiet: bool, tables: bool) -> None:
    """Run the blocks that are not finished yet, and put their figures together."""
    with resume_hint(f"ccnn run --resume {folder.path}"):
        blocks = blocks_of(config, folder)
        failed = finish_runs(blocks, config.engine, quiet)
        for name, problem in failed.items():
            kind = InputError if problem.input else MethodFailedError
            raise kind(
                f"block {name}: {problem.text}; {len(blocks) - len(failed)} of {len(blocks)} blocks are finished and "
                f"kept, and ccnn run --resume {folder.path} resumes from them"
            )
        write_blocks(config, folder, list(blocks.values()), lambda path: RUN.resume(path, quiet=True, tables=False))
    if tables and not quiet:
        run_page(RunResults.read(folder.results)).show(stdout)
        say_place(f"Everything is in {folder.path}")


def _run(config: RunConfig, prepared: Prepared | None, folder: RunFolder, quiet: bool, tables: bool) -> None:
    if prepared is None:
        _run_blocks(config, folder, quiet, tables)
        return
    for sentence in prepared.notes:
        note(sentence, quiet)
    folder = replace(folder, facts=fingerprint(config, prepared.data_hash))
    check_fingerprint(folder.checkpoints, folder.facts, folder.config)

    def watch(prepared: Prepared, method: str, phase: str, scaling: Scaling) -> list[Callback]:
        joints = prepared.mechanism.joints
        choosing = "cross-validating" if plan_of(config).folds > 1 else "choosing how long"
        label = f"{method}: {choosing if phase == 'choose' else 'training'}"
        board = folder.tensorboard / (method if phase == "fit" else f"{method}-{phase}")
        every = config.training.log_every
        past = partial(past_of, folder.checkpoint(method, phase))
        shown: list[Callback] = [
            TensorBoardCallback(board, every=every, past=past, tell=partial(note, quiet=quiet)),
            ProgressBar(label, quiet),
        ]
        if phase == "choose":
            # It has held-out errors of its own, of rows that are there to choose by.
            return shown
        names = tuple(joint.name for joint in joints)
        return [HeldOut(prepared.dataset, scaling, names, share_unit(joints), every), *shown]

    with resume_hint(f"ccnn run --resume {folder.path}"):
        calibration: Calibration = calibrate(config, folder, watch, prepared)
        note("writing model files, plots and tables …", quiet)
        try:
            write_outputs(calibration, folder)
        except WriteError:
            run_page(calibration.results).show(stdout)
            raise
    if tables and not quiet:
        run_page(calibration.results).show(stdout)
        say_place(f"Everything is in {folder.path}; open {folder.path / 'report.html'}")


RUN = FolderJob("ccnn run", RunConfig, "results.json", "checkpoints/*.safetensors", _prepared, _run)
"""A config to a finished run folder."""
