"""`ccnn identify`: from rows to the identified parameters of every method, their figures, and the folder of it all."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.split import Given
from ccnn_torch.display import typed_path
from ccnn_torch.errors import MethodFailedError, WriteError
from ccnn_torch.files.write import write_whole
from ccnn_torch.identification import Progress
from ccnn_torch.identification.config import ConstraintConfig, IdentifyConfig, base_method
from ccnn_torch.identification.constrained import identify_by_constraint
from ccnn_torch.identification.judge import drawn_errors, read_elsewhere, transferred
from ccnn_torch.identification.measured import Measured, from_records, held_by_priors, nominal_machine
from ccnn_torch.identification.page import identified_page, not_settled, write_identified_csv, write_identified_report
from ccnn_torch.identification.result import Found, assemble, beside_truth, judged, known_at, promised
from ccnn_torch.identification.simulated import count_study, simulate
from ccnn_torch.identification.solve import (
    QUICK,
    Outcome,
    frames_first,
    is_apart,
    load_outcome,
    pieces_of,
    run_method,
    save_outcome,
    select,
    solver_of,
    without_far_rows,
)
from ccnn_torch.mechanisms import Framed, Giving, Mechanism, SetUps
from ccnn_torch.mechanisms.mechanism_file import write_machine
from ccnn_torch.records import Records, write_table
from ccnn_torch.records.load import read_source
from ccnn_torch.report.arrays import ARRAYS_FILE, save_tensors
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.identified import IdentifiedResults
from ccnn_torch.report.screen import note, progress_bar, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, resume_hint
from ccnn_torch.run_folder.resume import FolderJob, check_fingerprint, fingerprint

Watch = Callable[[str], Progress]
"""Given a label, somewhere to report the share that is done."""


@dataclass
class Identification:
    """What an identification found.

    Attributes:
        measured: mechanism and rows.
        outcomes: by method; the first is the result.
        results: the content of `identified.json`.
        arrays: tensors behind the pictures, by name.
    """

    config: IdentifyConfig
    measured: Measured
    outcomes: Mapping[str, Outcome]
    results: dict[str, Any]
    arrays: dict[str, Tensor]
    given: Given | None = None

    def mechanism(self, machine: int = 0, method: str | None = None) -> Mechanism:
        """The mechanism with the identified parameters of one machine; by default the first method's.

        Of an arm that was measured in several set-ups the frames are those of the first one.
        """
        outcome = self.outcomes[method or next(iter(self.outcomes))]
        return _one(self.measured.mechanism, outcome.values[machine])

    def save(self, folder: str | Path) -> None:
        """Write what `ccnn identify` writes into a folder, which is made; a DataFrame's rows as `records.csv`."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        config = self.config
        if self.given is not None and not isinstance(self.given, Records):
            # What Python gave has no file that the config could name.
            table = read_source(self.given)
            write_table(folder / "records.csv", {table.header(name): table.raw(name) for name in table.names})
            config = config.model_copy(update={"records": str(folder / "records.csv")})
        write_whole(folder / "config.yaml", config.to_yaml(folder))
        write_outputs(self, folder)

    def nominal(self) -> dict[str, float]:
        """What the parameters were before, by name [SI]: nominal, or with the frames fitted."""
        before = _one(self.measured.mechanism, self.measured.start[0])
        return dict(zip((p.name for p in before.geometry), before.nominal.tolist(), strict=True))


def _one(mechanism: Mechanism, values: Tensor) -> Mechanism:
    return mechanism.one(values) if isinstance(mechanism, SetUps | Giving) else mechanism.with_nominal(values)


def prepare(config: IdentifyConfig, given: Given | None = None) -> tuple[Mechanism, Measured]:
    """Mechanism and rows of a config; the rows of `given` where Python has them."""
    mechanism = nominal_machine(config)
    if config.frame.base or config.frame.tool:
        mechanism = Framed(mechanism, base=config.frame.base, tool=config.frame.tool)
    measured = from_records(config, mechanism, given) if config.records is not None else simulate(config, mechanism)
    return mechanism, frames_first(measured, config)


def identify(
    config: IdentifyConfig, store: Path | None = None, watch: Watch | None = None, given: Given | None = None
) -> Identification:
    """Identify the parameters of a config by every method.

    Args:
        store: folder beside config.yaml in which each method's outcome is kept, and from which finished ones are
            taken.
        watch: receives the progress.
        given: records that Python has, in place of the config's file.

    Raises:
        InputError: the config, the mechanism or the data cannot be used; one sentence.
    """
    held = config
    if config.constraint is None:
        mechanism, measured = prepare(config, given)
        if held_by_priors(config, measured.mechanism):
            held = config.model_copy(update={"constraint": ConstraintConfig(kind="pose")})
    if held.constraint is not None:
        progress = None if watch is None else watch("lm")
        return Identification(config, *identify_by_constraint(held, progress, given), given=given)
    sound = without_far_rows(measured, config)
    measured = frames_first(sound, config) if sound.doubts else sound
    elsewhere = read_elsewhere(config, mechanism)
    for method in config.methods:  # refuse what cannot be solved before anything takes minutes
        solver_of(method, config)
        pieces_of(measured, config, is_apart(method, config), torch.arange(1))
    facts = fingerprint(config, _fingerprint(measured))
    if store is not None:
        check_fingerprint(sorted(store.glob("*.safetensors")), facts, store.parent / "config.yaml")
    outcomes: dict[str, Outcome] = {}
    for method in config.methods:
        path = None if store is None else store / f"{method}.safetensors"
        if path is not None and path.is_file():
            outcomes[method] = load_outcome(path)
            continue
        outcomes[method] = run_method(method, measured, config, None if watch is None else watch(method))
        if path is not None:
            save_outcome(path, outcomes[method], facts)
    judged_first = next(iter(outcomes.values())).values[0]
    results, arrays, outcomes = _judged(config, measured, outcomes)
    results["counts"] = count_study(config, mechanism)
    if elsewhere is not None:
        results["transfer"] = transferred(config, *elsewhere, judged_first)
    return Identification(config, measured, outcomes, results, arrays, given)


def _refitted(config: IdentifyConfig, measured: Measured, method: str, found: Found) -> Found:
    """The same with the values that all rows give, held-out ones among them, and what is known of these."""
    if not config.fits_again() or not measured.test.joints.shape[1] or base_method(method) not in QUICK:
        return found
    whole = replace(measured, rows=measured.rows.and_these(measured.test))
    outcome = run_method(method, whole, config)
    if not bool(outcome.converged.all()):
        return found
    pieces = pieces_of(whole, config, found.per_leg, outcome.machines, outcome.values)
    return replace(found, outcome=outcome, known=known_at(pieces, select(measured, config), outcome.values))


def _judged(
    config: IdentifyConfig, measured: Measured, outcomes: Mapping[str, Outcome]
) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Outcome]]:
    """The content of `identified.json`, tensors by name for the pictures, and the outcome of every method."""
    selection, first = select(measured, config), config.methods[0]
    picture = drawn_errors(measured, outcomes[first].values)
    found = {name: judged(config, measured, selection, name, outcome) for name, outcome in outcomes.items()}
    found = {name: _refitted(config, measured, name, one) for name, one in found.items()}
    outcomes = {name: one.outcome for name, one in found.items()}
    results, arrays = assemble(config, measured, selection, found, _given_noise(config, measured))
    arrays |= picture
    results["promise"] = promised(measured, found[first])
    if measured.truth is None:
        return results, arrays, outcomes
    arrays["truth"] = measured.truth
    for name, one_found in found.items():
        results["methods"][name] |= beside_truth(config, measured, selection, one_found)
    results["compensation"] = results["methods"][first]["compensation"]
    return results, arrays, outcomes


def _given_noise(config: IdentifyConfig, measured: Measured) -> float | None:
    if config.noise is None or measured.pose_noise is None:
        return None
    lengths = torch.tensor([c.unit == "m" for c in measured.mechanism.pose])
    return float(measured.pose_noise[lengths].square().sum().sqrt())


def _fingerprint(measured: Measured) -> str:
    """SHA-256 of the rows and of where the search begins."""
    digest = hashlib.sha256()
    rows = [measured.rows, measured.test, *measured.leg_rows.values()]
    for table in (measured.start, *(t for r in rows for t in (r.joints, r.observed))):
        digest.update(table.contiguous().numpy().tobytes())
    return digest.hexdigest()


RESULTS = "identified.json"


def write_outputs(found: Identification, folder: Path) -> None:
    """Write everything; `identified.json` comes last: a folder that has it is finished."""
    results = found.results
    write_identified_csv(folder / "identified.csv", results)
    write_whole(folder / "identified.md", identified_page(results).markdown())
    save_tensors(folder / ARRAYS_FILE, found.arrays)
    # Of several machines the first.
    config = found.config
    machine, measured = found.mechanism(), found.measured
    joints = torch.cat([measured.rows.joints[0], measured.test.joints[0]])
    ends = torch.stack([joints.amin(0), joints.amax(0)], -1).tolist()
    maps = config.columns, config.joint_map, {j.name: pair for j, pair in zip(machine.joints, ends, strict=False)}
    if bool(next(iter(found.outcomes.values())).converged[0]):
        # A machine at the values where a search stopped is none that commands may come from.
        write_machine(machine, found.nominal(), folder, "identified", *maps, source=str(config.mechanism))
    if found.config.save_report:
        write_identified_report(folder, results)
    write_json(folder / RESULTS, IdentifiedResults.model_validate(results))


def _run(config: IdentifyConfig, _data: None, folder: RunFolder, quiet: bool, details: bool | None) -> None:
    path = folder.path
    with progress_bar(quiet) as bar:

        def watch(label: str) -> Progress:
            task = bar.add_task(label, total=1.0)
            return lambda done: bar.update(task, completed=done)

        found = identify(config, path / "methods", watch)
    page = identified_page(found.results, folder=typed_path(str(path)))
    where = "the report" if config.save_report else RESULTS
    note("writing tables, plots and files …", quiet)
    with resume_hint(f"ccnn identify --resume {path}"):
        try:
            write_outputs(found, path)
        except WriteError:
            # What was found is not lost where the disk is full.
            page.show(stdout, bool(details), where)
            raise
    # Written already: whoever reads the screen may stop to.
    if details is not None and not quiet:
        page.show(stdout, details, where)
    if not quiet:
        place = typed_path(str(path))
        say_place(f"Everything is in {place}" + (f"; open {place}/report.html" if config.save_report else ""))
    if found.results["methods"][found.results["method"]]["converged"] == 0:
        why = " ".join([not_settled(found.results), *found.results["doubts"]])
        raise MethodFailedError(
            f"{why} What was written to {path} is there to look into it; no machine file is. More rows, "
            "more starts (starts=10) or fewer free parameters may help"
        )


IDENTIFY = FolderJob("ccnn identify", IdentifyConfig, RESULTS, "methods/*.safetensors", lambda c: None, _run)
"""A config to a finished folder; `MethodFailedError` where all is written, but the first method did not converge."""
