"""The command lines that put the effects of a diagnosis into a compensator, with the paths of the user."""

from __future__ import annotations

import json
import os
import shlex
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.diagnosis.from_file import Verdict, one_row_at_a_time, read_verdict
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.effects import OUTLIER, Acting, Situation, reached
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox


def compensate_lines(config: DiagnoseConfig, diagnosis: Diagnosis, path: Path) -> tuple[str, ...]:
    """A sentence, and the command lines to copy; () where there is nothing to compensate.

    Effects that a compensator cannot hold are left to its network, and the sentence says why.

    Args:
        config: of the diagnosis.
        diagnosis: what was found.
        path: the diagnosis.json that was written.
    """
    verdict, situation = diagnosis.verdict, diagnosis.analysis.situation
    if verdict["none"] or verdict["effects"] == [OUTLIER]:
        return ()
    recorded = {n: v for n, v in situation.covariates.items() if n not in diagnosis.inferred}
    situation = replace(situation, covariates=recorded)
    keys = {"records": _records(config), "mechanism": typed_path(str(config.mechanism))}
    for key, value in (
        ("columns", config.columns),
        ("joint_map", config.joint_map),
        ("mechanism_keys", config.mechanism_keys),
    ):
        if value:
            keys[key] = json.dumps(value, ensure_ascii=False)
    covariates = config.covariates
    try:
        named = read_verdict(path, situation.mechanism.name, [j.name for j in situation.mechanism.joints])
        named.on(situation)
        keys["effects"] = f"from:{typed_path(str(path))}"
        sentence = "These lines put the effects and a network on what they leave in a compensator and correct targets."
        needed = _outlasting(named, situation)
        covariates = covariates if needed is None else needed
    except InputError as reason:
        # What is wrong without the file and the remedy, which the lines are themselves.
        why = str(reason).removeprefix(f"{path}: ").partition(";")[0]
        sentence = f"These lines leave the gap to a network and correct targets ({why})."
    if covariates is not None:
        keys["covariates"] = f"[{','.join(covariates)}]"
    keys["out"] = f"{typed_path(str(path.parent))}_compensator"
    run = " ".join(["ccnn run", *(shlex.quote(f"{key}={value}") for key, value in keys.items())])
    model = shlex.quote(f"{keys['out']}/model.onnx")
    return sentence, run, f"ccnn compensate {model} TARGETS.csv COMMANDS.csv"


def _outlasting(named: Verdict, situation: Situation) -> list[str] | None:
    """The inputs without which the effects change; all but the time where something is beside them, for a network."""
    alone = one_row_at_a_time(situation)
    try:
        before = _acted(named, alone)
    except InputError:
        return None
    if named.outside or isinstance(situation.machine, BlackBox):
        return [*alone.covariates] if "time" in situation.covariates else None
    kept = dict(alone.covariates)
    for name in alone.covariates:
        fewer = {n: v for n, v in kept.items() if n != name}
        try:
            same = torch.equal(_acted(named, replace(alone, covariates=fewer)).nan_to_num(), before.nan_to_num())
        except InputError:
            continue
        kept = fewer if same else kept
    return [*kept]


def _acted(named: Verdict, situation: Situation) -> Tensor:
    """Poses of the rows under the effects, `s x c`."""
    return reached(situation, [Acting(one.effect, one.shape, one.coefficients) for one in named.on(situation)[0]])


def _records(config: DiagnoseConfig) -> str:
    files = config.records if isinstance(config.records, list) else [str(config.records)]
    return ",".join(typed_path(file) for file in files)


def typed_path(path: str) -> str:
    """A path as it may be typed here: relative where it is below the current folder."""
    near = os.path.relpath(path)
    return path if near.startswith("..") else near
