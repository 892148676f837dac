"""`ccnn diagnose --motion`: from a config to a verdict and its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ccnn_torch.config.sizes import size
from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.diagnosis.job import Job, head_of, run_job
from ccnn_torch.diagnosis.page.data import NEXT
from ccnn_torch.diagnosis.page.report import write_diagnosis_report
from ccnn_torch.diagnosis.verdict.text import in_doubt
from ccnn_torch.display import typed_path
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import write_rows
from ccnn_torch.motion.engine import MotionDiagnosis, diagnose_motion
from ccnn_torch.motion.identified import IDENTIFIED, write_identified
from ccnn_torch.motion.known import shares_of
from ccnn_torch.motion.log import load_logs
from ccnn_torch.motion.setting import nominal_of
from ccnn_torch.motion.stretches import phases_of
from ccnn_torch.plugins import is_plugin, permission

_STEPS = {
    "reading the records": 1.0,
    "searching the effects": 20.0,
    "judging on held-out rows": 4.0,
    "next measurements": 1.0,
}
_NOISE = ("The noise is what the most probable model leaves", "The noise was given")


def run_motion(config: DiagnoseConfig, quiet: bool = False, details: bool = False) -> Path:
    """Diagnose logs of a motion; as `run_job`, config: with `motion`, `mechanism` and `out`."""
    return run_job(Job(_STEPS, lambda config, tell: diagnosed(config), _complete), config, quiet, details)


def diagnosed(config: DiagnoseConfig) -> MotionDiagnosis:
    """Diagnose what a config names; nothing is written."""
    if not config.motion:
        raise InputError("motion: is missing; give --motion LOG.csv")
    if config.mechanism is None:
        raise InputError("mechanism: is missing; give --mechanism servo, a machine, or path/to/file.py:NAME")
    if config.records is not None:
        raise InputError("records and motion: a diagnosis is of poses or of a motion; give --records or --motion")
    logs = load_logs(
        [config.motion] if isinstance(config.motion, str) else config.motion, config.columns, config.motion_keys
    )
    nominal = nominal_of(config.mechanism, config.mechanism_keys, logs[0].units)
    nominal = replace(nominal, known=shares_of(config.exact or (), config.known))
    if isinstance(config.noise, dict):
        raise InputError("noise: of a motion must be one standard deviation of the position, such as 1e-3 or 0.1mrad")
    noise = None if config.noise is None else size(config.noise, None, "noise")
    found = diagnose_motion(logs, nominal, config.effects, noise, config.seed)
    for own in found.content["joints"]:
        own["word"] = logs[0].words.get(own["joint"], "")
    return found


def _complete(config: DiagnoseConfig, folder: Path, found: MotionDiagnosis, quiet: bool) -> list[str]:
    """The identified model, the motion to record next, and the report."""
    written = write_identified(folder, found, found.nominal, config.mechanism_keys)
    data = found.problem.data
    if found.proposed:
        # The commands of the first proposed motion, to be played.
        number = found.next_measurements[0]["motion"]["joint"].removeprefix("q")
        rows = zip(found.proposed[0].time.tolist(), found.proposed[0].command.tolist(), strict=True)
        write_rows(folder / NEXT, ["time[s]", f"command{number}[{data.units[0]}]"], map(list, rows))
    compensate = [
        "A wanted motion becomes the commands at which the machine follows it.",
        f"ccnn compensate {typed_path(str(folder / IDENTIFIED))} MOTION.csv COMMANDS.csv"
        + permission(is_plugin(found.nominal.name)),
    ]
    doubt = "; it may hold another cause" if in_doubt(found.content) else ""
    about = head_of(config, folder, config.motion, compensate if found.verdict["effects"] else []) | {
        "noise": f"{_NOISE[config.noise is not None]}{doubt}.",
        "units": {f"q{i + 1}": unit for i, unit in enumerate(data.units)},
    }
    drawn = {n: getattr(data, n).double() for n in ("time", "command", "position", "judged", "run")}
    drawn |= {"before": found.before, "after": found.after, "phase": phases_of(data).double()}
    write_diagnosis_report(folder, None, drawn, {"about": about})
    return ["report.html", *written]
