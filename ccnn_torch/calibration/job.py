"""`ccnn run`: a config to a finished run folder, and an unfinished folder to a finished one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.calibration.calibrate import Calibration, calibrate, makers
from ccnn_torch.calibration.callbacks import HeldOut, ProgressBar, TensorBoardCallback
from ccnn_torch.calibration.config import RunConfig, method_names
from ccnn_torch.calibration.evaluate import place_and_error
from ccnn_torch.calibration.fitting import check_storable
from ccnn_torch.calibration.page import errors_line, run_page, write_tables
from ccnn_torch.calibration.prepare import Prepared, TooManyRepeatsError, prepare
from ccnn_torch.calibration.result import by_score, plan_of
from ccnn_torch.calibration.statistics import reach_block, share_unit, spread
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import typed_path
from ccnn_torch.engine import Failure, Job, run_jobs
from ccnn_torch.errors import InputError, MethodFailedError, WriteError
from ccnn_torch.mechanisms import Instrument
from ccnn_torch.mechanisms.drawn import drawn
from ccnn_torch.plugins import is_plugin
from ccnn_torch.report.arrays import RunArrays, save_arrays, save_history
from ccnn_torch.report.json_files import plain, read_json, write_json
from ccnn_torch.report.results.run import ModelFiles, RmsMax, RunResults
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
    return errors_line(RunResults.read(RUN.finish(config, quiet, details=None).results))


def _run_blocks(config: RunConfig, folder: RunFolder, quiet: bool, details: bool | None) -> None:
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
        write_blocks(config, folder, list(blocks.values()), lambda path: RUN.resume(path, quiet=True, details=None))
    if details is not None and not quiet:
        run_page(RunResults.read(folder.results), folder=folder.path).show(stdout, details)
        say_place(f"Everything is in {typed_path(str(folder.path))}")


def _run(config: RunConfig, prepared: Prepared | None, folder: RunFolder, quiet: bool, details: bool | None) -> None:
    if prepared is None:
        _run_blocks(config, folder, quiet, details)
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
        run_page(calibration.results, folder=folder.path).show(stdout, details)
        place = typed_path(str(folder.path))
        say_place(f"Everything is in {place}; open {place}/report.html")


RUN = FolderJob("ccnn run", RunConfig, "results.json", "checkpoints/*.safetensors", _prepared, _run)
"""A config to a finished run folder."""


_SPREAD = {"median", "low", "high", "values"}
# What the exported repeat's block has, and its run. Checkpoints, curves of TensorBoard and the config stay there.
_KEPT = ("arrays.safetensors", "history-*.safetensors", "model.*", "card.json", "models")


def blocks_of(config: RunConfig, folder: RunFolder) -> dict[str, RunConfig]:
    """The blocks of a run by name, in the order of their seeds."""
    if config.methods == ["auto"]:
        raise InputError(
            "methods=auto chooses a method for all repeats together; name the methods, or write block=null"
        )
    assert config.block is not None
    size, digits = config.block, len(str(config.repeats - 1))
    found = {}
    for first in range(0, config.repeats, size):
        name = f"{first:0{digits}}"
        path = Path(os.path.abspath(folder.path)) / "blocks" / name
        own = {
            "name": f"{config.name}-{name}",
            "seed": config.seed + first,
            "repeats": min(size, config.repeats - first),
            "out": str(path),
            "engine": "local",
            "block": None,
            # Only one block has the model that is exported.
            "save_models": False,
            "save_report": False,
        }
        found[name] = config.model_copy(update=own)
    return found


def write_blocks(
    config: RunConfig, folder: RunFolder, blocks: Sequence[RunConfig], again: Callable[[Path], object]
) -> None:
    """Put the figures of finished blocks together, and export the best repeat of all."""
    found = [read_json(RunFolder(Path(str(block.out))).results) for block in blocks]
    for key, of in (("methods", _methods), ("geometry", _geometry)):
        if len({of(results) for results in found}) > 1:
            chosen = ", ".join(sorted({of(results) for results in found}))
            raise InputError(
                f"the blocks of repeats differ in {key}, which their rows chose ({chosen}); write {key}=… to have the "
                "same in all"
            )
    whole = merged(found)
    scores = {name: block["score"]["values"] for name, block in whole["methods"].items() if block["test"] is not None}
    best = min(scores, key=lambda name: float(np.median(scores[name])))
    if any(part["best_method"] != best for part in found):
        # Of other methods in some blocks, and not known of this one.
        whole["pose"].pop("energy", None)
    results = RunResults.model_validate(
        whole | {"name": config.name, "seed": config.seed, "repeats": config.repeats, "best_method": best}
    )
    for kind, left in results.methods[best].pose.items():
        if left is not None:
            results.pose[kind].after = RmsMax(rms=left.rms, max=left.max)
    first = int(np.argmin(scores[best]))
    exported = next(block for block in blocks if first < block.seed - config.seed + block.repeats)
    there = RunFolder(Path(str(exported.out)))
    if config.save_models:
        _export(exported, there, again)
        results.model = RunResults.read(there.results).model
    for pattern in _KEPT:
        for path in there.path.glob(pattern):
            if path.is_dir():
                shutil.copytree(path, folder.path / path.name, dirs_exist_ok=True)
            else:
                shutil.copy(path, folder.path / path.name)
    if config.save_report:
        from ccnn_torch.calibration.figures import write_report

        write_report(folder.path, results)
    else:
        write_tables(folder.path, results)
    write_json(folder.results, results)


def merged(parts: Sequence[Any]) -> Any:
    """Figures of several runs as those of one: spreads get the values of all, lists each entry once, the rest is the
    first run's."""
    first = parts[0]
    if isinstance(first, dict) and set(first) == _SPREAD:
        return plain(spread([np.nan if v is None else v for part in parts for v in part["values"]]))
    if isinstance(first, dict):
        common = {key: merged([part[key] for part in parts]) for key in first if all(key in part for part in parts)}
        if "spread" in common:
            # Plain numbers beside a spread are its medians.
            common |= {key: block["median"] for key, block in common["spread"].items()}
        return common
    if isinstance(first, list) and all(isinstance(entry, str) for entry in first):
        return list(dict.fromkeys(entry for part in parts for entry in part))
    return first


def _export(config: RunConfig, folder: RunFolder, again: Callable[[Path], object]) -> None:
    """Write the model files of a finished block; its training is in its checkpoints."""
    if (folder.path / "card.json").is_file():
        return
    folder.write("config.yaml", config.model_copy(update={"save_models": True}).to_yaml(folder.path))
    folder.results.unlink()
    again(folder.path)


def _methods(results: Mapping[str, Any]) -> str:
    return "+".join(sorted(name for name, block in results["methods"].items() if block["test"] is not None))


def _geometry(results: Mapping[str, Any]) -> str:
    return str(results["geometry"]["chosen"])


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
        from ccnn_torch.calibration.figures import write_report

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
