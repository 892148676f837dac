"""`ccnn run`: a config to a finished run folder, and an unfinished folder to a finished one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.calibration.calibrate import Calibration, calibrate, makers
from ccnn_torch.calibration.callbacks import HeldOut, ProgressBar, TensorBoardCallback
from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.calibration.evaluate import place_and_error
from ccnn_torch.calibration.fitting import check_storable
from ccnn_torch.calibration.page import run_page, write_tables
from ccnn_torch.calibration.prepare import Prepared, prepare
from ccnn_torch.calibration.result import by_score, plan_of
from ccnn_torch.calibration.statistics import reach_block, share_unit
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import typed_path
from ccnn_torch.errors import MethodFailedError, WriteError
from ccnn_torch.mechanisms import Instrument
from ccnn_torch.mechanisms.drawn import drawn
from ccnn_torch.plugins import is_plugin, names_code
from ccnn_torch.report.arrays import ARRAYS_FILE, RunArrays, load_arrays, save_arrays, save_history
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.run import ModelFiles, RunResults
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, resume_hint
from ccnn_torch.run_folder.resume import FolderJob, check_fingerprint, fingerprint
from ccnn_torch.training import Callback, Scaling, Training


def _check(config: RunConfig) -> None:
    """Make the learners, and look whether the networks of a user's own can be stored, before anything is computed."""
    learners = makers(config)
    for spec in filter(is_plugin, method_names(config)):
        make = learners[spec.rpartition(":")[2]]
        if config.save_models and make is not None:
            check_storable(spec, make())


def _prepared(config: RunConfig) -> Prepared:
    _check(config)
    return prepare(config)


def _run(config: RunConfig, prepared: Prepared, folder: RunFolder, quiet: bool, details: bool | None) -> None:
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
        shown: list[Callback] = [
            TensorBoardCallback(board, every=every, tell=partial(note, quiet=quiet)),
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
    if details is not None and not quiet:
        where = "the report" if config.save_report else "results.json"
        run_page(calibration.results, folder=folder.path).show(stdout, details, where)
        place = typed_path(str(folder.path))
        say_place(f"Everything is in {place}" + (f"; open {place}/report.html" if config.save_report else ""))


RUN = FolderJob("ccnn run", RunConfig, "results.json", "checkpoints/*.safetensors", _prepared, _run)
"""A config to a finished run folder."""


def write_outputs(calibration: Calibration, folder: RunFolder) -> None:
    """Model files, arrays, curves, plots, tables, report, and at last `results.json`."""
    path, results = folder.path, calibration.results
    curves = {name: _history(outcome.fitted.training) for name, outcome in calibration.outcomes.items()}
    results.reach = reach_block(curves)
    if calibration.config.save_models:
        results.model = _save_models(calibration, folder)
    save_arrays(path, _arrays(calibration))
    for method, history in curves.items():
        save_history(path, method, history)
    if calibration.config.save_report:
        write_report(path, results)
    else:
        write_tables(path, results)
    write_json(folder.results, results)


_LINKED = ("results.json", "results.csv", "card.json", "model.safetensors", "model.onnx", "config.yaml")


def write_report(folder: Path, results: RunResults) -> Path:
    """Write `results.csv`, `results.md`, `plots/` and `report.html` of a run folder; returns the path of the page.

    Reads `arrays.safetensors` where it is there; the same files give the same report, so it can be written again.

    Args:
        results: the content of its `results.json`.
    """
    # Loads matplotlib, which a run without pictures does not wait for.
    from ccnn_torch.report.figures import inline_figures, joint_error_plot, pose_error_plot, workspace_plot
    from ccnn_torch.report.machine import machine_plot

    write_tables(folder, results)
    plots = []
    if (folder / ARRAYS_FILE).is_file():
        arrays = load_arrays(folder)
        words = "With " + " + ".join([*results.pose.parts, arrays.labels.get("method", "the model")])
        # What mostly turns has no places to draw errors at, but a map of its angles.
        plots = [machine_plot(arrays.drawn, words) or workspace_plot(arrays)]
        plots += [pose_error_plot(arrays), joint_error_plot(arrays)]
    figures = inline_figures([plot for plot in plots if plot is not None], folder / "plots")
    return run_page(results, figures, Path(folder.name)).write_html(folder / "report.html", _LINKED)


def _save_models(calibration: Calibration, folder: RunFolder) -> ModelFiles:
    """Write every method's model files: `model.*` are those of the best method that can be written."""
    chosen: str | None = None
    without: dict[str, str] = {}
    damped: dict[str, float] = {}
    for method in by_score(calibration.outcomes):
        first = chosen is None
        try:
            share = calibration.save(folder.path if first else folder.models, method, "model" if first else method)
        except MethodFailedError as problem:
            without[method] = str(problem)
            continue
        chosen = chosen or method
        if share < 1:
            damped[method] = share
    named = names_code(calibration.mechanism().describe())
    return ModelFiles(method=chosen, without=without, damped=damped, allow_code=named)


def _arrays(calibration: Calibration) -> RunArrays:
    """What the pictures of the exported repeat need."""
    prepared, method, k = calibration.prepared, calibration.method, calibration.repeat()
    outcome, mechanism = calibration.outcomes[method], prepared.mechanism
    rows = prepared.joints.shape[1]
    test = torch.zeros(rows, dtype=torch.bool)
    test[prepared.dataset.splits[k].test] = True
    # A machine that mostly turns has its errors spread over angles, not over places.
    hand = _numpy(mechanism.hand(prepared.joints[k])) if isinstance(mechanism, Instrument) else None
    turns = hand is None and sum(coordinate.unit == "m" for coordinate in mechanism.pose) < 2
    axes = mechanism.pose if turns else tuple(Coordinate(name, "m") for name in "xyz")

    def place(poses: Tensor) -> NDArray[np.float64]:
        return _numpy(poses if turns else mechanism.frame(poses)[0])

    # Before compensation is before all of it: what geometry and known effects take away is part of the prediction.
    learned = prepared.dataset.deviation[k]
    whole = torch.where(torch.isfinite(prepared.total[k]), prepared.total[k], learned)
    systematic = outcome.after_systematic
    simulation = prepared.simulation
    return RunArrays(
        joints=mechanism.joints,
        commanded=_numpy(prepared.joints[k]),
        measured=_numpy(whole),
        predicted=_numpy(outcome.deviation[k] + (whole - learned)),
        test=test.numpy(),
        place=hand if hand is not None else place(prepared.pose[k]),
        position_before=_numpy(calibration.before.position[k]),
        position_after=_numpy(outcome.after.position[k]),
        rotation_before=None if calibration.before.rotation is None else _numpy(calibration.before.rotation[k]),
        rotation_after=None if outcome.after.rotation is None else _numpy(outcome.after.rotation[k]),
        noise=None if prepared.noise is None else _numpy(prepared.noise[k]),
        map_place=None if simulation is None else place(simulation.pose[k]),
        map_before=None if simulation is None else _numpy(simulation.pose_errors(prepared.joints)[1].position[k]),
        map_after=None if systematic is None else _numpy(systematic.position[k]),
        axes=axes,
        drawn={} if turns else {name: _numpy(value) for name, value in _drawn(calibration, test).items()},
        labels={"method": method, "repeat": str(k), "mechanism": mechanism.name},
    )


def _drawn(calibration: Calibration, test: Tensor) -> dict[str, Tensor]:
    """The machine with the errors of the rows `s` bool: vectors where positions were measured, else sizes."""
    prepared, k = calibration.prepared, calibration.repeat()
    mechanism, outcome = prepared.mechanism, calibration.outcomes[calibration.method]
    before, after = calibration.before.position[k], outcome.after.position[k]
    joints, pose = prepared.joints[k], prepared.pose[k] if prepared.simulation is None else prepared.simulation.pose[k]
    parameters = None if prepared.parameters is None else prepared.parameters[k].expand(len(joints), -1)[test]
    if isinstance(mechanism, Instrument):
        place = mechanism.hand(joints)
    elif outcome.left is None:
        place = mechanism.frame(pose)[0]
    else:
        (place, before), after = place_and_error(prepared, k), outcome.left[k, :, :3]
    joints, pose, place, before, after = (each[test].detach() for each in (joints, pose, place, before, after))
    return drawn(mechanism, joints, pose, place, before, after, parameters)


def _history(training: Training) -> dict[str, NDArray[np.float64]]:
    """Training curves for `save_history`; `seconds` are one repeat's share of those inside the learner, `t x r`."""
    repeats = len(training.best_step)
    seconds = (training.clock / repeats).unsqueeze(1).expand(-1, repeats)
    metrics = training.history | {"seconds": seconds}
    return {"step": np.arange(1.0, len(seconds) + 1)} | {name: _numpy(value) for name, value in metrics.items()}


def _numpy(tensor: Tensor) -> NDArray[np.float64]:
    return tensor.detach().cpu().numpy()
