"""A diagnosis from files, and what is written and shown of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from ccnn_torch.config.noise import noise_of_pose
from ccnn_torch.diagnosis import Diagnosis, diagnose, noise_of, situation_of
from ccnn_torch.diagnosis.checks.identifiable import Check, check_rows
from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.diagnosis.from_records import naming
from ccnn_torch.diagnosis.page.arrays import picture_arrays
from ccnn_torch.diagnosis.page.report import write_diagnosis_report
from ccnn_torch.diagnosis.verdict.text import noise_text
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import Records, load_records
from ccnn_torch.report.json_files import plain, write_json

__all__ = [
    "run_check",
    "run_diagnosis",
    "write_check",
    "write_diagnosis",
    "write_result",
]


def run_diagnosis(config: DiagnoseConfig) -> Diagnosis:
    """Load and diagnose.

    Raises:
        InputError: something is missing or wrong in the files or keys, or the rows carry no verdict.
    """
    records, mechanism, effects = _loaded(config)
    noise = _noise(config, mechanism)
    return diagnose(records, mechanism, noise=noise, effects=effects, gravity=config.gravity, seed=config.seed)


def run_check(config: DiagnoseConfig) -> Check:
    """Load and look at what the records can show; raises as `run_diagnosis`."""
    records, mechanism, effects = _loaded(config)
    situation = situation_of(records, mechanism, config.gravity)
    with naming(records):
        found = check_rows(situation, records.pose, noise_of(_noise(config, mechanism), situation), effects)
    return replace(found, lines_aside=[int(records.lines[row]) for row in found.aside])


def write_result(folder: Path, diagnosis: Diagnosis) -> Path:
    """Write `diagnosis.json` alone.

    Raises:
        InputError: the folder cannot be written.
    """
    path = folder / "diagnosis.json"
    write_json(path, plain(diagnosis.to_json()))
    return path


def write_check(folder: Path, check: Check) -> Path:
    """Write `check.json`; raises as `write_result`."""
    path = folder / "check.json"
    write_json(path, asdict(check))
    return path


def write_diagnosis(folder: Path, diagnosis: Diagnosis, about: Mapping[str, str] | None = None, seed: int = 0) -> Path:
    """Write `diagnosis.json`, the arrays behind its pictures, and the report.

    Args:
        folder: is made where it is not there.
        diagnosis: what to write.
        about: for the head of the report: `name`, `mechanism`, `records`.
        seed: of the diagnosis.

    Raises:
        InputError: the folder cannot be written.
    """
    path = write_result(folder, diagnosis)
    arrays, labels = picture_arrays(diagnosis, seed)
    mechanism = diagnosis.analysis.situation.mechanism
    units = covariate_units(mechanism) | {c.name: c.unit for c in (*mechanism.pose, *mechanism.joints)}
    lines = [diagnosis.lines[row] for row in diagnosis.rows_set_aside] if diagnosis.lines else []
    told = {
        "noise": noise_text(diagnosis.analysis.whitening.known > 0),
        **(about or {}),
        "units": units,
        "lines": lines,
    }
    write_diagnosis_report(folder, plain(diagnosis.to_json()), arrays, labels | {"about": told})
    return path


def _noise(config: DiagnoseConfig, mechanism: Mechanism) -> dict[str, float] | None:
    return None if config.noise is None else noise_of_pose(config.noise, mechanism.pose)


def _loaded(config: DiagnoseConfig) -> tuple[Records, Mechanism, Sequence[str] | None]:
    for key in ("records", "mechanism"):
        if getattr(config, key) is None:
            raise InputError(f"{key}: is missing; give --{key}, or the key in a config")
    mechanism = load_mechanism(str(config.mechanism), **config.mechanism_keys)
    assert config.records is not None
    records = load_records(config.records, mechanism, config.covariates, learns=False, columns=config.columns)
    return records, mechanism, config.effects
