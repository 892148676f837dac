"""`ccnn diagnose --motion`: from a config to a verdict and its folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.config.sizes import size
from ccnn_torch.diagnosis.config import DiagnoseConfig, folder_of
from ccnn_torch.diagnosis.job import typed_path
from ccnn_torch.diagnosis.page.data import NEXT, RESULT, about_of, load_labels
from ccnn_torch.diagnosis.page.report import print_diagnosis, write_diagnosis_report
from ccnn_torch.diagnosis.progress import watched
from ccnn_torch.diagnosis.verdict.text import in_doubt
from ccnn_torch.display import short_path
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import sweep
from ccnn_torch.motion.engine import MotionDiagnosis, diagnose_motion
from ccnn_torch.motion.identified import IDENTIFIED, write_identified
from ccnn_torch.motion.log import load_logs
from ccnn_torch.motion.models import nominal_of
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.phases import phases_of
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.json_files import plain, write_json
from ccnn_torch.report.results.diagnosis import DiagnosisResults
from ccnn_torch.report.screen import say_place, stdout, step_bar
from ccnn_torch.report.table import print_text
from ccnn_torch.run_folder.folder import if_stopped, locked

_STEPS = {
    "reading the records": 1.0,
    "searching the effects": 20.0,
    "judging on held-out rows": 4.0,
    "next measurements": 1.0,
}
_NOISE = ("The noise is what the most probable model leaves", "The noise was given")


def run_motion(config: DiagnoseConfig, quiet: bool = False, details: bool = False) -> Path:
    """Diagnose logs of a motion, and write the folder of the config; the verdict is kept before the report is drawn.

    Args:
        config: with `motion`, `mechanism` and `out`.
        quiet: no verdict, no table, no progress.
        details: show all tables.

    Raises:
        InputError: something is missing or wrong in the files or keys, or the folder cannot be written.
    """
    folder = folder_of(config)
    stopped = if_stopped("interrupted before there was a verdict; nothing was written")
    with stopped, step_bar(_STEPS, quiet) as tell, watched(tell):
        found, nominal = diagnosed(config)
    results = plain(DiagnosisResults.model_validate(found.to_json()))
    with locked(folder):
        sweep(folder)
        write_json(folder / RESULT, results)
        kept = f"interrupted after the verdict, which is kept in {folder / RESULT}; the rest is not complete"
        with if_stopped(kept):
            if not quiet:
                print_text(results["verdict"]["text"], stdout, "bold")
            written = write_identified(folder, found, nominal, config.mechanism_keys)
            _report(config, folder, results, found)
            if not quiet:
                print_diagnosis(results, stdout, about_of(load_labels(folder)), verdict=False, details=details)
                say_place(
                    f"Written: {typed_path(str(folder / RESULT))}, and beside it report.html, {', '.join(written)}"
                )
    return folder


def diagnosed(config: DiagnoseConfig) -> tuple[MotionDiagnosis, Nominal]:
    """Diagnose what a config names, and the model that was; nothing is written."""
    if not config.motion:
        raise InputError("motion: is missing; give --motion LOG.csv")
    if config.mechanism is None:
        raise InputError("mechanism: is missing; give --mechanism servo, a machine, or path/to/file.py:NAME")
    if config.records is not None:
        raise InputError("records and motion: a diagnosis is of poses or of a motion; give --records or --motion")
    logs = load_logs([config.motion] if isinstance(config.motion, str) else config.motion, config.columns)
    nominal = nominal_of(config.mechanism, config.mechanism_keys, logs[0].units)
    if isinstance(config.noise, dict):
        raise InputError("noise: of a motion must be one standard deviation of the position, such as 1e-3 or 0.1mrad")
    noise = None if config.noise is None else size(config.noise, None, "noise")
    return diagnose_motion(logs, nominal, config.effects, noise, config.seed), nominal


def _report(config: DiagnoseConfig, folder: Path, results: Mapping[str, Any], found: MotionDiagnosis) -> None:
    data, files = found.problem.data, config.motion if isinstance(config.motion, list) else [config.motion]
    if found.proposed:
        # The commands of the first proposed motion, to be played.
        number = str(results["next_measurements"][0]["motion"]["joint"]).removeprefix("q")
        rows = zip(found.proposed[0].time.tolist(), found.proposed[0].command.tolist(), strict=True)
        write_rows(folder / NEXT, ["time[s]", f"command{number}[{data.units[0]}]"], map(list, rows))
    named = ["A wanted motion becomes the commands at which the machine follows it."]
    named += [f"ccnn compensate {typed_path(str(folder / IDENTIFIED))} MOTION.csv COMMANDS.csv"]
    about = {
        "compensate": named if results["verdict"]["effects"] else [],
        "name": folder.name,
        "mechanism": short_path(str(config.mechanism)),
        "records": ", ".join(short_path(str(file)) for file in files),
        "noise": f"{_NOISE[config.noise is not None]}{'; it may hold another cause' if in_doubt(results) else ''}.",
        "folder": typed_path(str(folder)),
        "units": {f"q{i + 1}": unit for i, unit in enumerate(data.units)},
    }
    drawn = {n: getattr(data, n).double() for n in ("time", "command", "position", "judged", "run")}
    drawn |= {"before": found.before, "after": found.after, "phase": phases_of(data).double()}
    write_diagnosis_report(folder, results, drawn, {"about": about})
