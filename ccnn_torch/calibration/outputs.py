"""Write the run folder; `results.json` is written last."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.calibration.calibrate import Calibration
from ccnn_torch.calibration.learning.progress import genome
from ccnn_torch.calibration.page.reach import reach_block
from ccnn_torch.calibration.page.tables import write_tables
from ccnn_torch.calibration.result import by_score
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.mechanisms import Instrument
from ccnn_torch.report.arrays import RunArrays, save_arrays, save_history
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.run import ModelFiles
from ccnn_torch.run_folder.folder import RunFolder
from ccnn_torch.training import Training


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
        # Loads matplotlib, which a run without pictures does not wait for.
        from ccnn_torch.calibration.page.report import write_report

        write_report(path, results)
    else:
        write_tables(path, results)
    write_json(folder.results, results)


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
    return ModelFiles(method=chosen, without=without, damped=damped)


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
    masks, weights = genome(outcome.fitted.learner, k)
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
        masks=tuple(mask.numpy() for mask in masks),
        weights=tuple(_numpy(weight) for weight in weights),
        axes=axes,
        labels={"method": method, "repeat": str(k), "mechanism": mechanism.name},
    )


def _history(training: Training) -> dict[str, NDArray[np.float64]]:
    """Training curves for `save_history`; `seconds` are one repeat's share of those inside the learner, `t x r`."""
    repeats = len(training.best_step)
    seconds = (training.clock / repeats).unsqueeze(1).expand(-1, repeats)
    metrics = training.history | {"seconds": seconds}
    return {"step": np.arange(1.0, len(seconds) + 1)} | {name: _numpy(value) for name, value in metrics.items()}


def _numpy(tensor: Tensor) -> NDArray[np.float64]:
    return tensor.detach().cpu().numpy()
