"""`ccnn diagnose` and `ccnn check`: from a config to a verdict and its folder."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from ccnn_torch.config.sizes import noise_of_pose
from ccnn_torch.diagnosis import Diagnosis, diagnose, noise_of, situation_of, with_network
from ccnn_torch.diagnosis.checks.identifiable import Check, check_rows
from ccnn_torch.diagnosis.config import DiagnoseConfig, folder_of
from ccnn_torch.diagnosis.from_records import constant_columns, naming
from ccnn_torch.diagnosis.page.data import RESULT, About, about_of, load_labels
from ccnn_torch.diagnosis.page.first_screen import first_screen
from ccnn_torch.diagnosis.page.outputs import promise_of_verdict, write_diagnosis, write_result
from ccnn_torch.diagnosis.page.report import print_diagnosis
from ccnn_torch.diagnosis.progress import TO_REPORT, TO_VERDICT, watched
from ccnn_torch.diagnosis.result import Said
from ccnn_torch.diagnosis.verdict.text import both_sides
from ccnn_torch.display import short_path, typed_path
from ccnn_torch.effects import OUTLIER
from ccnn_torch.effects.constant import Frame
from ccnn_torch.effects.time import Homing
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import sweep
from ccnn_torch.mechanisms import Framed, Mechanism, Seen, SerialArm, load_mechanism, simulated_rows
from ccnn_torch.plugins import names_code, permission
from ccnn_torch.records import Records, load_records
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.screen import say_place, stdout, step_bar
from ccnn_torch.report.table import print_labelled
from ccnn_torch.run_folder.folder import if_stopped, locked

_Found = TypeVar("_Found", bound=Said)


class Job(NamedTuple, Generic[_Found]):
    """What the diagnosis of poses and that of a motion do each in its way; the rest of both is `run_job`.

    Attributes:
        steps: to the verdict, with about the seconds that each takes.
        diagnose: from the config to the verdict; its second argument reports the progress.
        complete: what takes longer than the verdict: writes the report, and returns the files beside `diagnosis.json`.
    """

    steps: Mapping[str, float]
    diagnose: Callable[[DiagnoseConfig, Callable[..., None]], _Found]
    complete: Callable[[DiagnoseConfig, Path, _Found, bool], Sequence[str]]


def run_diagnosis(config: DiagnoseConfig, quiet: bool = False, details: bool = False) -> Path:
    """Diagnose poses; as `run_job`."""
    return run_job(Job(TO_VERDICT, _verdict, _complete), config, quiet, details)


def run_job(job: Job[_Found], config: DiagnoseConfig, quiet: bool, details: bool) -> Path:
    """Diagnose, and write the folder of the config; the verdict is shown and kept before all that takes longer.

    Args:
        job: of poses or of a motion.
        config: of the diagnosis.
        quiet: no verdict, no table, no progress.
        details: show all tables.

    Raises:
        InputError: something is missing or wrong in the files or keys, the rows carry no verdict, or the folder cannot
            be written. A verdict that cannot be kept is printed.
    """
    folder = folder_of(config)
    stopped = if_stopped("interrupted before there was a verdict; nothing was written")
    with stopped, step_bar(job.steps, quiet) as tell, watched(tell):
        said = job.diagnose(config, tell)
    try:
        with locked(folder):
            sweep(folder)
            kept = write_result(folder, said)
            with if_stopped(f"interrupted after the verdict, which is kept in {kept}; the rest is not complete"):
                if not quiet:
                    first = first_screen(said.to_json(), About())[0]
                    print_labelled(first.label, first.text, stdout)
                beside = job.complete(config, folder, said, quiet)
                if not quiet:
                    results = read_json(kept)
                    print_diagnosis(results, stdout, about_of(load_labels(folder)), begun=True, details=details)
                    say_place(f"Written: {typed_path(str(kept))}, and beside it {', '.join(beside)}")
    except InputError:
        print_diagnosis(said.to_json(), stdout)
        raise
    return folder


def run_check(config: DiagnoseConfig) -> Check:
    """What the records of a config can show; raises as `run_diagnosis`."""
    records, mechanism, effects = _loaded(config)
    situation = situation_of(records, mechanism, config.gravity)
    with naming(records):
        found = check_rows(situation, records.pose, noise_of(_noise(config, records), situation), effects)
    doubts = [*found.cautions, *([records.doubt] if records.doubt else [])]
    still = constant_columns(records)
    missing = {
        name: f"{why}, which never change{both_sides(why)}" if any(f"{c}[" in why for c in still) else why
        for name, why in found.missing.items()
    }
    lines = [int(records.lines[row]) for row in found.aside]
    return replace(found, lines_aside=lines, cautions=doubts, missing=missing)


def _verdict(config: DiagnoseConfig, tell: Callable[..., None]) -> Diagnosis:
    records, mechanism, effects = _loaded(config)
    noise = _noise(config, records)
    with simulated_rows(lambda n: tell(note=f"{n:,} rows simulated")):
        keys: dict[str, Any] = {"noise": noise, "effects": effects, "gravity": config.gravity, "seed": config.seed}
        said = diagnose(records, mechanism, **keys)
    if said.machine is not None:
        said.machine.update(columns=config.columns, joint_map=config.joint_map)
    return said.with_entries(promise=promise_of_verdict(said, config.seed))


def _complete(config: DiagnoseConfig, folder: Path, said: Diagnosis, quiet: bool) -> list[str]:
    """The network on the remainder, and the report."""
    steps = TO_REPORT if config.network else {"figures and report": TO_REPORT["figures and report"]}
    with step_bar(steps, quiet) as tell:
        if config.network:
            said = with_network(said, config.seed, lambda share: tell("network on the remainder", share))
        tell("figures and report")
        about = head_of(config, folder, config.records, compensate_lines(config, said, folder / RESULT))
        write_diagnosis(folder, said, about, config.seed, str(config.mechanism))
    return ["report.html"]


def head_of(
    config: DiagnoseConfig, folder: Path, files: str | list[str] | None, compensate: Sequence[str]
) -> dict[str, Any]:
    """What `About` holds of any job; files: that were diagnosed."""
    listed = files if isinstance(files, list) else [files]
    return {
        "name": folder.name,
        "mechanism": short_path(str(config.mechanism)),
        "records": ", ".join(short_path(str(file)) for file in listed),
        "folder": typed_path(str(folder)),
        "compensate": compensate,
    }


def _noise(config: DiagnoseConfig, records: Records) -> dict[str, float] | None:
    """Of the pose as it was measured: an arm's records may have positions alone."""
    return None if config.noise is None else noise_of_pose(config.noise, records.pose_coordinates)


def _loaded(config: DiagnoseConfig) -> tuple[Records, Mechanism, Sequence[str] | None]:
    for key in ("records", "mechanism"):
        if getattr(config, key) is None:
            raise InputError(f"{key}: is missing; give --{key}, or the key in a config")
    mechanism = load_mechanism(str(config.mechanism), **config.mechanism_keys)
    assert config.records is not None
    records = load_records(
        config.records, mechanism, config.covariates, learns=False, columns=config.columns, joint_map=config.joint_map
    )
    return records, mechanism, config.effects


def compensate_lines(config: DiagnoseConfig, diagnosis: Diagnosis, path: Path) -> tuple[str, ...]:
    """A sentence, and the command lines to copy; () where there is nothing to compensate.

    Args:
        config: of the diagnosis.
        diagnosis: what was found.
        path: the diagnosis.json that was written.
    """
    verdict, covariates = diagnosis.verdict, config.covariates
    # The next session has another zero, which no model of these rows knows.
    vain = verdict["effects"] in ([OUTLIER], [Homing.name]) and not verdict["outside_library"]
    if verdict["none"] or vain:
        return ()
    keys = {"records": _records(config), "mechanism": typed_path(str(config.mechanism))}
    for key, value in (
        ("columns", config.columns),
        ("joint_map", config.joint_map),
        ("mechanism_keys", config.mechanism_keys),
    ):
        if value:
            keys[key] = json.dumps(value, ensure_ascii=False)
    given = diagnosis.analysis.situation.covariates
    if covariates is None and "time" in given and diagnosis.machine is not None:
        # A model that asks for the time holds for that day.
        covariates = [n for n in given if n != "time" and n not in diagnosis.inferred]
    if covariates is not None:
        keys["covariates"] = f"[{','.join(covariates)}]"
    keys["out"] = f"{typed_path(str(path.parent))}_compensator"
    run, machine = _run_line(keys), diagnosis.analysis.situation.mechanism
    own = names_code(machine.describe())
    rest = f"TARGETS.csv COMMANDS.csv --pose{permission(own)}"
    if diagnosis.machine is None:
        model = shlex.quote(f"{keys['out']}/model.safetensors")
        sentence = "No model holds these effects by themselves: these lines learn the gap and correct targets."
        return sentence, run, f"ccnn compensate {model} {rest}"
    sentence = "the first line corrects targets by these effects alone, the second one trains a model of all that pays."
    lines = [f"ccnn compensate {shlex.quote(typed_path(str(path)))} {rest}", run]
    has_frames = isinstance(machine, SerialArm | Framed | Seen) or not {"x", "y", "z"} <= {c.name for c in machine.pose}
    if Frame.name in verdict["effects"] and not has_frames:
        inside = {"mechanism": keys["mechanism"], "base": True, "keys": config.mechanism_keys}
        keys |= {"mechanism": "framed", "mechanism_keys": json.dumps({k: v for k, v in inside.items() if v})}
        lines.append(_run_line(keys))
        sentence = f"{sentence[:-1]}; the third one fits the frame first, where it is the measuring device's own."
    return sentence, *lines


def _run_line(keys: Mapping[str, str]) -> str:
    return " ".join(["ccnn run", *(shlex.quote(f"{key}={value}") for key, value in keys.items())])


def _records(config: DiagnoseConfig) -> str:
    files = config.records if isinstance(config.records, list) else [str(config.records)]
    return ",".join(typed_path(file) for file in files)
