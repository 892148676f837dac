"""`ccnn run`: a config to a finished run folder, and an unfinished folder to a finished one."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ccnn_torch.report.results import share_unit
from ccnn_torch.report.tables import print_tables
from ccnn_torch.report.tensorboard import TensorBoardCallback
from ccnn_torch.runs.assemble import plan_of
from ccnn_torch.runs.calibrate import Calibration, calibrate, makers
from ccnn_torch.runs.config import RunConfig, dump_config, load_config
from ccnn_torch.runs.folder import RunFolder
from ccnn_torch.runs.outputs import write_outputs
from ccnn_torch.runs.prepare import Prepared, prepare
from ccnn_torch.runs.screen import note, say_place, stdout
from ccnn_torch.runs.watch import HeldOut, ProgressBar
from ccnn_torch.training import Callback, Scaling, past_of

__all__ = ["resume_run", "start_run"]


def start_run(config: RunConfig, quiet: bool = False, tables: bool = True) -> RunFolder:
    """Run a config into a fresh folder.

    Args:
        quiet: no progress and no tables.
        tables: show the results when it is done.

    Raises:
        InputError: the config or its data cannot be used, or the folder is taken.
    """
    makers(config)
    prepared = prepare(config)
    folder = RunFolder.create(config.out, config.name)
    folder.write_text("config.yaml", dump_config(config, folder.path))
    _run(config, prepared, folder, quiet, tables)
    return folder


def resume_run(path: Path, quiet: bool = False, tables: bool = True) -> RunFolder:
    """Finish the run in a folder; the result is that of a run that was never stopped. A finished one stays as it is.

    Args:
        quiet, tables: as in `start_run`.

    Raises:
        InputError: there is no run in the folder, or its records or checkpoints were changed.
    """
    folder = RunFolder.existing(path)
    if folder.finished:
        note(f"{path} is finished; nothing to do", quiet)
        return folder
    config = load_config(folder.config, [])
    _run(config, prepare(config), folder, quiet, tables)
    return folder


def _run(config: RunConfig, prepared: Prepared, folder: RunFolder, quiet: bool, tables: bool) -> None:
    for sentence in prepared.notes:
        note(sentence, quiet)

    def watch(prepared: Prepared, method: str, phase: str, scaling: Scaling) -> list[Callback]:
        joints = prepared.mechanism.joints
        choosing = "cross-validating" if plan_of(config).folds > 1 else "choosing how long"
        label = f"{method}: {choosing if phase == 'choose' else 'training'}"
        board = folder.tensorboard / (method if phase == "fit" else f"{method}-{phase}")
        every = config.training.log_every
        past = partial(past_of, folder.checkpoint(method, phase))
        shown: list[Callback] = [TensorBoardCallback(board, every=every, past=past), ProgressBar(label, quiet)]
        if phase == "choose":
            # It has held-out errors of its own, of rows that are there to choose by.
            return shown
        names = tuple(joint.name for joint in joints)
        return [HeldOut(prepared.dataset, scaling, names, share_unit(joints), every), *shown]

    calibration: Calibration = calibrate(config, folder, watch, prepared)
    note("writing model files, plots and tables …", quiet)
    write_outputs(calibration, folder)
    if tables and not quiet:
        print_tables(calibration.results, stdout)
        say_place(f"Everything is in {folder.path}; open {folder.path / 'report.html'}")
