"""`ccnn blind-check`: machines with sealed truth, their diagnoses, and the figures after opening; resumable."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from ccnn_torch.effects import EFFECTS, Effect, make_effect
from ccnn_torch.engine import Job, run_jobs
from ccnn_torch.errors import CcnnError, InputError, MethodFailedError
from ccnn_torch.files.write import sweep
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import Records, load_records
from ccnn_torch.report.json_files import read_json, write_json
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.run_folder.folder import kept_for, locked
from ccnn_validation.blind.folder import BlindFolder
from ccnn_validation.blind.machines import MACHINES
from ccnn_validation.blind.plan import KINDS, plan_cases
from ccnn_validation.blind.report import summary, write_blind
from ccnn_validation.blind.tables import case_line, print_blind

__all__ = ["Diagnoser", "run_blind_check"]


class Answer(Protocol):
    """What a diagnosis gives."""

    def to_json(self) -> Mapping[str, Any]:
        """The content of diagnosis.json."""


class Diagnoser(Protocol):
    """`ccnn_torch.diagnosis.diagnose`, or one of the same signature."""

    def __call__(
        self,
        records: Records,
        mechanism: Mechanism,
        *,
        noise: Mapping[str, float] | None = None,
        effects: Sequence[Effect] | None = None,
    ) -> Answer:
        """Diagnose records; `effects` is the library to use, all of it when None."""


def run_blind_check(
    cases: int,
    out: str | Path,
    diagnose: Diagnoser,
    *,
    seed: int = 0,
    machines: Sequence[str] = MACHINES,
    kinds: Sequence[str] = tuple(KINDS),
    engine: str = "local",
    quiet: bool = False,
) -> Path:
    """Generate, seal, diagnose, open, diagnose without the effect that was there, and count.

    A second call with the same arguments resumes an interrupted one; finished steps are kept.

    Args:
        cases: their number.
        out: folder.
        diagnose: the diagnosis to check.
        seed: of the cases.
        machines: simulators, of `plan.SIMULATORS`.
        kinds: of `plan.KINDS`.
        engine: where the cases are diagnosed: `local`, `processes`, `dask`, or a scheduler's address.

    Returns:
        The path of `blind.json`.

    Raises:
        InputError: an argument that does not fit, or a folder of another check or in use.
        MethodFailedError: the generating process failed.
    """
    plan_cases(cases, seed, machines, kinds)
    folder = BlindFolder(Path(out).absolute())
    settings = {"cases": cases, "seed": seed, "machines": list(machines), "kinds": list(kinds)}
    with locked(folder.path), kept_for("the same command"):
        sweep(folder.path)
        return _checked(folder, settings, diagnose, engine, quiet)


def _checked(folder: BlindFolder, settings: dict[str, Any], diagnose: Diagnoser, engine: str, quiet: bool) -> Path:
    _settle(folder, settings)
    if not folder.seal.is_file():
        note(f"generating {settings['cases']} sealed cases in a process of their own", quiet)
        _generator("write", folder)
    public_cases = read_json(folder.public)["cases"]
    _diagnose_all(folder, public_cases, diagnose, None, engine, quiet)
    if not folder.truth.is_file():
        note("opening the seal", quiet)
        _generator("open", folder)
    truth = read_json(folder.truth)["cases"]
    absent = {c["number"]: c["causes"][0] for c in truth if c["kind"] == "single" and c["causes"][0] in EFFECTS}
    without = {number: [name for name in EFFECTS if name != cause] for number, cause in absent.items()}
    _diagnose_all(folder, [t for t in public_cases if t["number"] in absent], diagnose, without, engine, quiet)
    if not folder.judged.is_file():
        note("judging", quiet)
        _generator("judge", folder)
    found = summary(read_json(folder.judged)["cases"])
    if not quiet:
        print_blind(found, stdout)
    path = write_blind(folder.path, found)
    if not quiet:
        say_place(f"Everything is in {folder.path}")
    return path


def _settle(folder: BlindFolder, settings: dict[str, Any]) -> None:
    """Write the settings; in an existing folder, check that they are equal."""
    if folder.settings.is_file():
        there = read_json(folder.settings)
        other = sorted(key for key in settings if there.get(key) != settings[key])
        if other:
            raise InputError(
                f"{folder.path} holds a blind check that differs in {', '.join(other)}; give another folder with "
                "--out, or remove that one"
            )
        return
    write_json(folder.settings, settings)


def _generator(what: str, folder: BlindFolder) -> None:
    """Run the generating side in a process of its own."""
    command = [sys.executable, "-m", "ccnn_validation.blind.generator", what, str(folder.path)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 2:
        raise InputError(done.stderr.strip())
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise MethodFailedError(f"the process that generates blind cases failed ({last})")


def _diagnose_all(
    folder: BlindFolder,
    public_cases: Sequence[Mapping[str, Any]],
    diagnose: Diagnoser,
    without: Mapping[int, Sequence[str]] | None,
    engine: str,
    quiet: bool,
) -> None:
    """Diagnose the cases without a diagnosis."""
    withheld = without is not None
    machines: dict[str, Mechanism] = {}
    jobs = [
        Job(
            f"case {case['number']}",
            folder.diagnosis(case["number"], withheld),
            partial(_diagnosed, folder, case, diagnose, None if without is None else without[case["number"]], machines),
        )
        for case in public_cases
    ]
    for name, problem in run_jobs(jobs, engine, partial(note, quiet=quiet)).items():
        raise MethodFailedError(f"{name}: {problem.text}; the same command resumes from the other cases")


def _diagnosed(
    folder: BlindFolder,
    case: Mapping[str, Any],
    diagnose: Diagnoser,
    library: Sequence[str] | None,
    machines: dict[str, Mechanism],
) -> str:
    """Diagnose a case and write the answer; machines that were read before are kept in `machines`."""
    number, name = case["number"], case["machine"]
    if name not in machines:
        machines[name] = load_mechanism(str(folder.machine(name)))
    began = time.perf_counter()
    answer: dict[str, Any]
    try:
        records = load_records(folder.records(number), machines[name], learns=False)
        effects = None if library is None else [make_effect(effect) for effect in library]
        answer = dict(diagnose(records, machines[name], noise=case["noise"], effects=effects).to_json())
    except CcnnError as problem:
        answer = {"failed": str(problem)}
    answer["seconds"] = time.perf_counter() - began
    write_json(folder.diagnosis(number, library is not None), answer)
    return case_line(name, answer, library is not None)
