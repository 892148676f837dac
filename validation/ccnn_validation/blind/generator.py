"""The generating side of a blind check, run as a process of its own: `python -m … write FOLDER`, `… open FOLDER`,
`… judge FOLDER`.

It alone knows the causes. `write` leaves records and digests; `open`, once every diagnosis is on
disk, writes the truth; `judge` compares all answers with it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.files.write import make_folder, write_whole
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.mechanism_file import dh_text, mechanism_text
from ccnn_torch.records import write_table
from ccnn_torch.report.json_files import read_json, write_json
from ccnn_validation.blind.case import BlindCase
from ccnn_validation.blind.folder import BlindFolder
from ccnn_validation.blind.judge import judged
from ccnn_validation.blind.machines import BlindMachine
from ccnn_validation.blind.plan import plan_cases
from ccnn_validation.blind.simulate import simulate
from ccnn_validation.blind.truth import digest, file_digest, truth_of

__all__ = ["judge_cases", "open_cases", "write_cases"]

_AT_ONCE = 60


def write_cases(folder: BlindFolder) -> None:
    """Write records, machines and their public description, and the seal last."""
    settings = read_json(folder.settings)
    seals: dict[str, dict[str, str]] = {}
    public_cases: list[dict[str, Any]] = []
    make_folder(folder.records(0).parent)
    for case in _cases(settings):
        number = case.plan.number
        _write_machine(folder, case.plan.machine, case.machine)
        path = folder.records(number)
        columns = {c.header: case.joints[:, i].numpy() for i, c in enumerate(case.machine.mechanism.joints)}
        columns |= {c.header: case.measured[:, i].numpy() for i, c in enumerate(case.machine.mechanism.pose)}
        columns |= {c.header: values.numpy() for c, values in case.columns.items()}
        write_table(path, columns)
        seals[str(number)] = {"truth": digest(truth_of(case)), "records": file_digest(path)}
        names = [c.name for c in case.machine.mechanism.pose]
        noise = dict(zip(names, case.sd.tolist(), strict=True)) if case.plan.noise_told else None
        public_cases.append({"number": number, "machine": case.plan.machine, "noise": noise})
    write_json(folder.public, {"cases": public_cases})
    write_json(folder.seal, {"cases": seals})


def open_cases(folder: BlindFolder) -> None:
    """Draw the truth again, compare it with the seal, and write it.

    Raises:
        InputError: a diagnosis is missing, or the truth or a file is not the one that was sealed.
    """
    seal = read_json(folder.seal)["cases"]
    missing = [n for n in map(int, seal) if not folder.diagnosis(n).is_file()]
    if missing:
        raise InputError(f"{folder.path}: case {missing[0]} is not diagnosed yet; the seal stays closed")
    truths = []
    for case in _cases(read_json(folder.settings)):
        number = case.plan.number
        truths.append(truth_of(case))
        if digest(truths[-1]) != seal[str(number)]["truth"]:
            raise InputError(
                f"{folder.seal}: what this version draws for case {number} is not what was sealed; use a new folder"
            )
        if file_digest(folder.records(number)) != seal[str(number)]["records"]:
            raise InputError(f"{folder.records(number)}: was changed after it was sealed; use a new folder")
    write_json(folder.truth, {"cases": truths})


def judge_cases(folder: BlindFolder) -> None:
    """Judge all answers; the truth must be open."""
    truths = read_json(folder.truth)["cases"]
    found = []
    for truth, case in zip(truths, _cases(read_json(folder.settings)), strict=True):
        answers = [_answer(folder, case.plan.number, withheld) for withheld in (False, True)]
        found.append({**truth, **judged(case, *answers)})
    write_json(folder.judged, {"cases": found})


def _cases(settings: dict[str, Any]) -> list[BlindCase]:
    plans = plan_cases(settings["cases"], settings["seed"], settings["machines"], settings["kinds"])
    chunks = (plans[first : first + _AT_ONCE] for first in range(0, len(plans), _AT_ONCE))
    return [case for chunk in chunks for case in simulate(chunk, settings["seed"])]


def _answer(folder: BlindFolder, number: int, withheld: bool) -> dict[str, Any] | None:
    path = folder.diagnosis(number, withheld)
    return read_json(path) if path.is_file() else None


def _write_machine(folder: BlindFolder, name: str, machine: BlindMachine) -> None:
    path = folder.machine(name)
    if path.is_file():
        return
    mechanism = machine.mechanism
    if isinstance(mechanism, SerialArm):
        text = dh_text(mechanism)
    else:
        nominal = dict(zip((p.name for p in mechanism.geometry), mechanism.nominal.tolist(), strict=True))
        text = mechanism_text(mechanism, nominal)
    write_whole(path, text)


def _main(arguments: Sequence[str]) -> int:
    torch.set_num_threads(1)
    what, path = arguments
    try:
        {"write": write_cases, "open": open_cases, "judge": judge_cases}[what](BlindFolder(Path(path)))
    except CcnnError as problem:
        sys.stderr.write(f"{problem}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
