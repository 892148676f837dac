"""The program as a user calls it: a calibration, and commands by each of the files that it wrote."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ccnn_validation.delivered.machine import Machine, Pose
from ccnn_validation.delivered.plan import Rows, joined
from ccnn_validation.delivered.rotation import Array
from ccnn_validation.delivered.tables import Commands, read_commands, write_records, write_targets

COMMANDS = ("run", "diagnose", "identify")
FORMS = ("safetensors", "onnx", "c")
_KELVIN = 273.15
_MAIN = """#include <stdio.h>
#include "compensator.h"

int main(void) {
    double joints[%(joints)d], covariates[%(most)d], command[%(joints)d], deviation[%(joints)d];
    for (;;) {
        for (int i = 0; i < %(joints)d; i++) if (scanf("%%lf", joints + i) != 1) return 0;
        for (int i = 0; i < %(covariates)d; i++) if (scanf("%%lf", covariates + i) != 1) return 1;
        int status = ccnn_compensate(joints, %(given)s, command, deviation);
        for (int i = 0; i < %(joints)d; i++) printf("%%.17g ", command[i]);
        printf("%%d\\n", status);
    }
}
"""


@dataclass
class Contestant:
    """A calibration by the program.

    Attributes:
        folder: where the files of this machine are.
        command: which of `COMMANDS` made the model.
        model: its file; None where the program refused.
        said: sentences of calls that failed, and tracebacks.
    """

    folder: Path
    command: str
    model: Path | None = None
    said: list[str] = field(default_factory=list)

    def call(self, *arguments: str) -> bool:
        """Run the program in the folder; keep what it says, and return whether it ended with 0."""
        done = subprocess.run(
            [sys.executable, "-m", "ccnn_torch", *arguments], cwd=self.folder, capture_output=True, text=True
        )
        with (self.folder / "said.txt").open("a") as file:
            file.write(f"$ ccnn {' '.join(arguments)}\n{done.stdout}{done.stderr}exit {done.returncode}\n\n")
        if done.returncode or "Traceback" in done.stderr:
            lines = done.stderr.strip().splitlines() or ["nothing on stderr"]
            self.said.append(f"{arguments[0]}: exit {done.returncode}: {lines[-1][:300]}")
        return done.returncode == 0


def calibrated(
    machine: Machine, rows: Rows, measured: Pose, command: str, keys: Sequence[str], out: Path
) -> Contestant:
    """Write records, machine and config, and calibrate.

    Args:
        machine, rows, measured: what was measured.
        command: one of `COMMANDS`; of `diagnose` the model is its diagnosis.json.
        keys: overrides `key=value` of the calibration.
        out: folder for the files.
    """
    out = out.resolve()
    contestant = Contestant(out, command)
    out.mkdir(parents=True, exist_ok=True)
    (out / "said.txt").unlink(missing_ok=True)
    write_records(out / "measured.csv", machine, rows, measured)
    if machine.files.text is not None:
        (out / machine.files.mechanism).write_text(machine.files.text)
    config = ["records: measured.csv", f"mechanism: {machine.files.mechanism}"]
    if machine.files.keys:
        config.append(f"mechanism_keys: {json.dumps(dict(machine.files.keys))}")
    split = "{kind: random, test: 0.3}" if command == "identify" else "{kind: random, test: 0.3, validation: 0.2}"
    (out / "config.yaml").write_text("\n".join([*config, f"split: {split}", ""]))
    if command == "identify":
        if contestant.call("identify", "config.yaml", "out=model", *keys):
            contestant.model = out / "model" / "identified.yaml"
        return contestant
    if command == "diagnose":
        if contestant.call("diagnose", "--config", "config.yaml", "--no-network", "--out", "model"):
            contestant.model = out / "model" / "diagnosis.json"
        return contestant
    if contestant.call("run", "config.yaml", "out=model", "save_report=false", *keys):
        contestant.model = out / "model" / "model.safetensors"
        if not contestant.model.is_file():
            contestant.said.append("run: exit 0 without a model file")
    return contestant


def promised(contestant: Contestant) -> dict[str, float | None]:
    """`after` and, where it is there, `explained` of position [m] and rotation [rad] in the results."""
    found: dict[str, float | None] = dict.fromkeys(("position", "rotation", "position_explained", "rotation_explained"))
    if contestant.model is None:
        return found
    folder = contestant.model.parent
    if contestant.command == "identify":
        test = json.loads((folder / "identified.json").read_text())["test"]
        return found | {name: _figure(test.get(name), "after") for name in ("position", "rotation")}
    if contestant.command == "diagnose":
        said = json.loads(contestant.model.read_text())
        gaps = {"position": said["gap"], "rotation": said["gap_rotation"]}
        return found | {name: _figure(gap, "after") for name, gap in gaps.items()}
    pose = json.loads((folder / "results.json").read_text())["pose"]
    for name in ("position", "rotation"):
        found[name] = _figure(pose.get(name), "after")
        found[f"{name}_explained"] = _figure(pose.get(name), "explained")
    return found


def _figure(block: Mapping[str, Any] | None, name: str) -> float | None:
    """The median RMS of a block of the results, or a plain number there."""
    value = (block or {}).get(name)
    for key in ("rms", "median"):
        if isinstance(value, dict):
            value = value.get(key)
    return None if value is None else float(value)


def delivered(contestant: Contestant, form: str, machine: Machine, sets: Mapping[str, Rows]) -> dict[str, Commands]:
    """Commands of each set of rows by one of `FORMS`; nothing where the program did not give them."""
    if contestant.model is None or not contestant.model.is_file():
        return {}
    rows = joined(sets)
    found = _by_c(contestant, machine, rows) if form == "c" else _by_file(contestant, form, machine, rows)
    if found is None:
        return {}
    ends = np.cumsum([len(part.joints) for part in sets.values()])[:-1]
    parts = zip(np.split(found.joints, ends), np.split(found.status, ends), strict=True)
    return {name: Commands(*part) for name, part in zip(sets, parts, strict=True)}


def _by_file(contestant: Contestant, form: str, machine: Machine, rows: Rows) -> Commands | None:
    assert contestant.model is not None
    model = contestant.model
    if form == "onnx":
        model = model.parent / "model.onnx"
        if not model.is_file():
            if not contestant.call("export", str(contestant.model), "--to", "onnx", "--out", "onnx"):
                return None
            model = contestant.folder / "onnx" / "model.onnx"
    out = contestant.folder / f"commands_{form}.csv"
    write_targets(contestant.folder / "targets.csv", machine, rows)
    contestant.call("compensate", str(model), "targets.csv", out.name)
    # A row that falls back ends with 2 and is written all the same.
    return read_commands(out, len(machine.units)) if out.is_file() else None


def _by_c(contestant: Contestant, machine: Machine, rows: Rows) -> Commands | None:
    assert contestant.model is not None
    if not contestant.call("export", str(contestant.model), "--to", "c99", "--out", "c"):
        return None
    folder, count = contestant.folder / "c", len(machine.units)
    card = contestant.model.parent / "card.json"
    if contestant.command == "diagnose":
        names = [*json.loads(contestant.model.read_text())["machine"]["covariates"]]
    else:
        names = [_name(c) for c in json.loads(card.read_text())["covariates"]] if card.is_file() else []
    numbers = {"joints": count, "covariates": len(names), "most": max(len(names), 1)}
    (folder / "main.c").write_text(_MAIN % {**numbers, "given": "covariates" if names else "NULL"})
    sources, program = ["main.c", "compensator.c"], folder / "judge"
    built = subprocess.run(
        ["gcc", "-std=c99", "-O1", *sources, "-o", program.name, "-lm"], cwd=folder, capture_output=True, text=True
    )
    if built.returncode:
        contestant.said.append(f"gcc: {built.stderr.strip()[:300]}")
        return None
    columns = [rows.joints] + [_in_si(name, rows.covariates[name])[:, None] for name in names]
    text = "\n".join(" ".join(f"{v:.17g}" for v in line) for line in np.concatenate(columns, -1))
    answer = subprocess.run([str(program.resolve())], input=text, capture_output=True, text=True, check=True).stdout
    table = np.array([line.split() for line in answer.splitlines()], float)
    return Commands(table[:, :count], table[:, count])


def _name(covariate: Any) -> str:
    name = covariate["name"] if isinstance(covariate, dict) else covariate
    return str(name).partition("[")[0]


def _in_si(name: str, values: Array) -> Array:
    return values + _KELVIN if name == "temperature" else values
