"""The command lines that put the effects of a diagnosis into a compensator, with the paths of the user."""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path

from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.effects import OUTLIER


def compensate_lines(config: DiagnoseConfig, diagnosis: Diagnosis, path: Path) -> tuple[str, ...]:
    """A sentence, and the command lines to copy; () where there is nothing to compensate.

    Args:
        config: of the diagnosis.
        diagnosis: what was found.
        path: the diagnosis.json that was written.
    """
    verdict, covariates = diagnosis.verdict, config.covariates
    if verdict["none"] or verdict["effects"] == [OUTLIER]:
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
    run = " ".join(["ccnn run", *(shlex.quote(f"{key}={value}") for key, value in keys.items())])
    if diagnosis.machine is None:
        model = shlex.quote(f"{keys['out']}/model.onnx")
        sentence = "No model holds these effects by themselves: these lines learn the gap and correct targets."
        return sentence, run, f"ccnn compensate {model} TARGETS.csv COMMANDS.csv"
    sentence = (
        "The first line corrects targets by the machine with these effects alone, the second one fits all effects that "
        "pay, and learns what they leave where that pays."
    )
    return sentence, f"ccnn compensate {shlex.quote(typed_path(str(path)))} TARGETS.csv COMMANDS.csv", run


def _records(config: DiagnoseConfig) -> str:
    files = config.records if isinstance(config.records, list) else [str(config.records)]
    return ",".join(typed_path(file) for file in files)


def typed_path(path: str) -> str:
    """A path as it may be typed here: relative where it is below the current folder."""
    near = os.path.relpath(path)
    return path if near.startswith("..") else near
