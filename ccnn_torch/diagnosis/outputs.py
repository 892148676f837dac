"""The folder of a diagnosis: `diagnosis.json`, the arrays of its figures, the report; and `check.json`."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ccnn_torch.diagnosis.checks.identifiable import Check
from ccnn_torch.diagnosis.page.arrays import picture_arrays
from ccnn_torch.diagnosis.page.data import CORRECTED, RESULT
from ccnn_torch.diagnosis.page.report import write_diagnosis_report
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.diagnosis.verdict.text import noise_text
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Framed, SerialArm, fit_frames
from ccnn_torch.mechanisms.mechanism_file import write_machine
from ccnn_torch.report.json_files import plain, write_json
from ccnn_torch.report.results.diagnosis import DiagnosisResults


def write_result(folder: Path, diagnosis: Diagnosis) -> Path:
    """Write `diagnosis.json` alone.

    Raises:
        InputError: the folder cannot be written.
    """
    path = folder / RESULT
    write_json(path, DiagnosisResults.model_validate(diagnosis.to_json()))
    return path


def write_check(folder: Path, check: Check) -> Path:
    """Write `check.json`; raises as `write_result`."""
    path = folder / "check.json"
    write_json(path, asdict(check))
    return path


def write_diagnosis(folder: Path, diagnosis: Diagnosis, about: Mapping[str, Any] | None = None, seed: int = 0) -> Path:
    """Write `diagnosis.json`, the arrays of its figures, the report, and of a named geometry the corrected machine.

    Args:
        folder: made where it does not exist.
        diagnosis: what to write.
        about: for the head of the report: what `About` holds.
        seed: of the diagnosis.

    Raises:
        InputError: the folder cannot be written.
    """
    path = write_result(folder, diagnosis)
    for name in CORRECTED:
        (folder / name).unlink(missing_ok=True)
    # A machine that no file describes has no corrected one, and the report does not wait for it.
    with suppress(InputError):
        write_corrected(folder, diagnosis)
    arrays, labels = picture_arrays(diagnosis, seed)
    mechanism = diagnosis.analysis.situation.mechanism
    units = covariate_units(mechanism) | {c.name: c.unit for c in (*mechanism.pose, *mechanism.joints)}
    lines = [diagnosis.lines[row] for row in diagnosis.rows_set_aside] if diagnosis.lines else []
    noise = noise_text(diagnosis.noise)
    labels = labels | {"about": {"noise": noise, **(about or {}), "units": units, "lines": lines}}
    write_diagnosis_report(folder, plain(diagnosis.to_json()), arrays, labels)
    return path


def write_corrected(folder: Path, diagnosis: Diagnosis) -> None:
    """The machine with the geometry that was named, all of its numbers in it and its frames fitted again."""
    analysis, mechanism = diagnosis.analysis, diagnosis.analysis.situation.mechanism
    named = [e["parameters"] for e in diagnosis.effects if e["name"] in diagnosis.verdict["effects"]]
    found = {n: b["value"] for parameters in named for n, b in parameters.items() if b.get("nominal") is not None}
    frames = analysis.situation.parameters
    # Frames by group of rows are no machine's.
    if not found or (frames is not None and frames.dim() > 1):
        return
    before = mechanism.nominal if frames is None else frames
    names = [p.name for p in mechanism.geometry]
    change = torch.tensor([found.get(name, 0.0) for name in names], dtype=torch.float64)
    machine = mechanism.with_nominal(mechanism.nominal + change)
    rows = analysis.situation.joints, analysis.measured
    if isinstance(machine, SerialArm) and machine.unknown_frames:
        machine = machine.with_nominal(fit_frames(machine, *rows))
    elif isinstance(machine, Framed) and machine.unknown_frames:
        machine = machine.with_nominal(machine.inlying_frames(*rows))
    nominal = dict(zip(names, before.tolist(), strict=True))
    maps = [(diagnosis.machine or {}).get(key) for key in ("columns", "joint_map")]
    write_machine(machine, nominal, folder, Path(CORRECTED[0]).stem, *maps)
