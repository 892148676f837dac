"""Diagnose the cases of an independent source and judge the answers, resumable: one file for each case."""

from __future__ import annotations

import importlib
import time
import zlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import torch
from numpy.typing import NDArray

from ccnn_torch.diagnosis import Diagnosis, diagnose
from ccnn_torch.diagnosis.residual.linearisation import remainder
from ccnn_torch.engine import Job, run_jobs
from ccnn_torch.errors import CcnnError, InputError, MethodFailedError
from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.motion import diagnose_motion, load_logs, nominal_of
from ccnn_torch.records import load_records, write_table
from ccnn_torch.report.json_files import read_json, write_json
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.report.table import print_table
from ccnn_torch.run_folder.folder import locked, resume_hint
from ccnn_validation.sources.case import Source, SourceCase
from ccnn_validation.sources.judge import judged
from ccnn_validation.sources.report import source_tables, write_source

__all__ = ["SOURCES", "diagnosed", "run_source", "source_of"]

_Task = tuple[str, str, int, Path]
"""Source, family, seed, and the file of its answer."""
SOURCES = ("semi_real", "multibody", "adversarial", "motion", "shop", "since")


def source_of(name: str) -> Source:
    """The source of that name.

    Raises:
        InputError: there is none.
    """
    if name not in SOURCES:
        raise InputError(f"--source: '{name}' is not there; known: blind, {', '.join(SOURCES)}")
    return cast(Source, importlib.import_module(f"ccnn_validation.sources.{name}"))


def run_source(
    name: str, cases: int, out: Path, seed: int = 0, engine: str = "processes", quiet: bool = False
) -> list[dict[str, Any]]:
    """Diagnose and judge the cases of a source, and write its figures; finished cases are kept.

    Args:
        name: of `SOURCES`.
        cases: their number, rounded up to as many for each family.
        out: folder to write, with one file for each case.
        seed: of the first case of each family; the others follow.
        engine: where they are diagnosed: `local`, `processes`, `dask`, or a scheduler's address.

    Raises:
        InputError: an unknown source, no case, a folder in use, or data that the source reads is not there.
    """
    source = source_of(name)
    if cases < 1:
        raise InputError(f"--cases: generate at least 1 case, not {cases}")
    seeds = range(seed, seed + -(-cases // len(source.FAMILIES)))
    out = out.absolute()
    with locked(out), resume_hint("the same command"):
        tasks = [
            (name, family, number, out / f"{family}-{number}.json") for number in seeds for family in source.FAMILIES
        ]
        jobs = [Job(f"{task[1]} {task[2]}", task[3], partial(_one, task)) for task in tasks]
        failed = run_jobs(jobs, engine, partial(note, quiet=quiet))
        line = next((f"{name}: {problem.text}" for name, problem in failed.items()), "")
        every = [dict(read_json(task[3])) for task in tasks if task[3].is_file()]
        found = [case for case in every if "skipped" not in case]
        if not found:
            raise InputError(f"--source {name}: no case can be made ({line})")
        write_source(out, name, found)
    if not quiet:
        for table in source_tables(name, found):
            print_table(table, stdout)
        say_place(f"Everything is in {out}")
    return found


def _one(task: _Task) -> str:
    name, family, seed, path = task
    try:
        case = source_of(name).make(family, seed)
    except InputError as problem:
        # Not kept: the data may be there the next time.
        raise MethodFailedError(f"skipped, {problem}") from None
    began = time.perf_counter()
    answer = diagnosed(case, case.columns)
    seconds = time.perf_counter() - began
    baseline = None if case.baseline is None else diagnosed(case, case.baseline)
    truth = case.truth
    already = (
        frozenset(baseline["verdict"]["effects"]) if baseline is not None and "verdict" in baseline else frozenset()
    )
    if any(names and names <= already for names in truth.accepted):
        write_json(path, {"skipped": f"{family}: the name is in the verdict on the rows without the cause"})
        return "skipped, the machine has the cause already"
    found = {
        "source": name,
        "family": case.family,
        "seed": seed,
        "kind": truth.kind,
        "causes": list(truth.causes),
        "accepted": [sorted(names) for names in truth.accepted],
        "truth_outside": truth.outside,
        "drivers": list(truth.drivers),
        "noise_kind": case.noise_kind,
        "noise_given": case.noise is not None,
        "rows": len(next(iter(case.columns.values()))),
        "seconds": seconds,
        **judged(truth, answer, baseline),
        "shrink": answer.get("true_shrink"),
        "cautions": answer.get("cautions"),
    }
    write_json(path, found)
    return f"{'right' if found['right'] else 'WRONG'} {found.get('names')} {found.get('drivers')}"


def diagnosed(case: SourceCase, columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """The answer to records of a case, as a user gets it from files; `{"failed": sentence}` where it is refused."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "records.csv"
        write_table(path, dict(columns))
        if "command1[rad]" in columns:
            return _in_motion(case, path)
        try:
            mechanism = _mechanism(case, Path(folder))
            records = load_records(path, mechanism, learns=False)
            noise = (
                None
                if case.noise is None
                else {c.name: case.noise[c.unit] for c in mechanism.pose if c.unit in case.noise}
            )
            found = diagnose(records, mechanism, noise=noise)
        except CcnnError as problem:
            return {"failed": str(problem)}
    return {**found.to_json(), "true_shrink": _shrink(case, found)}


def _in_motion(case: SourceCase, path: Path) -> dict[str, Any]:
    """The answer to the log of a motion."""
    mechanism = case.mechanism
    if "\n" in mechanism:
        mechanism = str(path.parent / f"machine-{zlib.crc32(case.mechanism.encode()):08x}.xml")
        write_whole(Path(mechanism), case.mechanism)
    try:
        logs = load_logs([path])
        return {**diagnose_motion(logs, nominal_of(mechanism, case.mechanism_keys or {}, logs[0].units)).to_json()}
    except CcnnError as problem:
        return {"failed": str(problem)}


def _mechanism(case: SourceCase, folder: Path) -> Mechanism:
    keys = dict(case.mechanism_keys or {})
    if "\n" not in case.mechanism:
        return load_mechanism(case.mechanism, **keys)
    # The name says which machine it is: the same text has the same name.
    kind = "urdf" if case.mechanism.startswith("<robot") else "yaml"
    path = folder / f"machine-{zlib.crc32(case.mechanism.encode()):08x}.{kind}"
    write_whole(path, case.mechanism)
    return load_mechanism(str(path), **keys)


def _shrink(case: SourceCase, found: Diagnosis) -> dict[str, Any] | None:
    """The interval of the shrink against what the named effects take away of the noise-free gap."""
    verdict, clean = found.verdict, case.clean
    if clean is None or verdict["shrink"] is None or verdict["shrink_ci95"] is None or not found.acting:
        return None
    situation = found.analysis.situation
    pose = torch.stack([torch.from_numpy(clean[c.header]) for c in situation.mechanism.pose], -1)
    if len(pose) != len(situation.joints):
        return None
    keep = found.analysis.whitening.counted
    before, after = (
        float(remainder(situation, pose, acting)[keep][:, :3].square().sum(-1).nanmean())
        for acting in ((), found.acting)
    )
    if before == 0:
        return None
    low, high = verdict["shrink_ci95"]
    true = 1 - after / before
    return {"true": true, "said": verdict["shrink"], "low": low, "high": high, "holds": bool(low <= true <= high)}
