"""The page of `ccnn verify`: its sentences, tables and figures, from the content of `verify.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.page.data import NEXT, About
from ccnn_torch.diagnosis.page.tables import quantity_text, write_next_csv
from ccnn_torch.display import count_text, display_unit, number_text, with_unit
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.page import Answer, Page, sections_of
from ccnn_torch.report.results.verify import Error, Promised, SinceResults, VerifyResults
from ccnn_torch.report.table import Table


def write_since(
    folder: Path, results: SinceResults, joints: Sequence[Coordinate], picture: Mapping[str, Tensor]
) -> None:
    """Write `since.json`, `since.html`, `plots/` and `next_measurements.csv` into a folder, which is made.

    Args:
        folder: where to write.
        results: the content of `since.json`.
        joints: of the machine.
        picture: as `what_changed` gives it.

    Raises:
        InputError: the folder cannot be written.
    """
    facts = (
        results.mechanism,
        count_text(results.rows, "new row"),
        count_text(results.configurations, "configuration"),
    )
    # Loads matplotlib, which no other command waits for.
    from ccnn_torch.report.figures import inline_figures
    from ccnn_torch.report.machine import machine_plot

    drawn = {name: value.detach().numpy() for name, value in picture.items()}
    after = "With what changed in it" if results.changed else "Nothing taken off"
    plots = [plot for plot in (machine_plot(drawn, after),) if plot is not None]
    look = " ".join(dict.fromkeys(told.look for told in results.changed))
    answers = [Answer("Look at", look)] if look else []
    if results.next_measurements:
        answers.append(Answer("Measure next", f"{len(results.next_measurements)} poses: {NEXT}."))
    page = Page(
        name=f"{results.model} and {results.records}",
        kind="what changed",
        verdict=results.text,
        sections=sections_of(since_tables(results, joints), inline_figures(plots, folder / "plots"), answers),
        facts=" · ".join(facts),
        notes=results.notes,
        worse=results.rest,
    )
    page.write_html(folder / "since.html", ["since.json", NEXT])
    write_json(folder / "since.json", results)
    units = {joint.name: joint.unit for joint in joints}
    poses = [{"joints": one.joints, "covariates": {}, "gain": one.gain} for one in results.next_measurements]
    write_next_csv(folder / NEXT, {"next_measurements": poses}, About(units=units))


def since_tables(results: SinceResults, joints: Sequence[Coordinate]) -> list[Table | None]:
    """What changed with its numbers, the error of the new rows, all that was weighed, and the poses to measure next."""
    numbers = []
    for told in results.changed:
        for one in told.numbers:
            value, sd = (with_unit(v, one.unit, like=one.value) for v in (one.value, one.sd))
            numbers.append((told.text, one.name, value, sd, " or ".join(told.instead) or "–"))
    columns = ("what", "number", "more than in the model", "standard deviation", "these rows do not tell it from")
    changed = Table("What changed?", columns, numbers, words=("number", columns[-1])) if numbers else None
    gaps = []
    first = "position" if results.position.unit == "m" else "direction"
    for kind, gap in ((first, results.position), ("rotation", results.rotation)):
        if gap is not None:
            scale, unit = display_unit(gap.unit, gap.before)
            cells = (number_text(None if v is None else v / scale, 3) for v in (gap.before, gap.after, gap.promised))
            gaps.append((f"{kind} [{unit}]", *cells))
    note = (
        "RMS. Explained: what the change leaves of each configuration when it is fitted to the others. Promised: of "
        "rows held out when the model was made."
    )
    errors = Table("Error of the new rows about the model", ("", "RMS", "explained", "promised"), gaps, note)
    rows = [
        (change.text, number_text(change.probability, 2), with_unit(change.seen_from, change.unit, 2))
        for change in results.changes
    ]
    note = "Seen from: the smallest change of one number that these rows would have shown, with odds of about 20 to 1."
    weighed = Table("What was weighed?", ("change", "probability", "seen from"), rows, note)
    text = {change.name: change.text for change in results.changes}
    wanted = [
        (
            *(quantity_text(pose.joints[j.name], j.unit) for j in joints),
            " or ".join(text[name] for name in pose.separates) or "–",
            number_text(pose.gain, 3),
        )
        for pose in results.next_measurements
    ]
    headers = (*(j.name for j in joints), "separates", "gain [nat]")
    note = f"The same as a file: {NEXT}."
    poses = Table("What should be measured next?", headers, wanted, note, ("separates",)) if wanted else None
    return [changed, errors, weighed, poses]


def write_verify_report(folder: Path, results: VerifyResults, arrays: RunArrays) -> list[Path]:
    """Write `verify.html` and `verify.json` into a folder, which is made."""
    # Imported here: it loads matplotlib.
    from ccnn_torch.report.figures import inline_figures, joint_error_plot, pose_error_plot

    plots = [pose_error_plot(arrays), joint_error_plot(arrays)]
    with TemporaryDirectory() as scratch:
        figures = [
            figure._replace(caption=figure.caption.replace("held-out row", "new row"))
            for figure in inline_figures(plots, Path(scratch))
        ]
    facts = (
        results.mechanism,
        f"{results.rows} new rows, {count_text(results.configurations, 'configuration')}, "
        f"{results.outside_domain} outside the model's domain",
        f"measured {'with the compensator on' if results.compensated else 'without compensation'}",
        f"measuring frame: {results.frames}",
    )
    page = Page(
        name=f"{results.model} on {results.records}",
        kind="verification",
        verdict=results.text,
        sections=sections_of(verify_tables(results), figures),
        facts=" · ".join(facts),
        notes=results.notes,
    )
    page.write_html(folder / "verify.html", ["verify.json"])
    write_json(folder / "verify.json", results)
    return [folder / "verify.json", folder / "verify.html"]


def verify_text(results: VerifyResults) -> str:
    """The verdict in one or two sentences."""
    blocks = {kind: results[kind] for kind in results.kinds}
    promised = {kind: block for kind, block in blocks.items() if block.promised is not None}
    rows = count_text(results.rows, "row")
    how = "measured with the model in use" if results.compensated else "measured without compensation"
    left = " and ".join(_left(block, kind) for kind, block in blocks.items())
    if not promised:
        verdict = "is lower" if results.kept else "is not lower"
        return (
            f"The model promises no figure; on {rows} {how} the {results.kinds[0]} error {verdict} than before at "
            f"95 %: {left}."
        )
    broken = [kind for kind, block in promised.items() if block.after.rms > block.promised.high]
    limits = " and ".join(_limit(block, block.promised, kind) for kind, block in promised.items())
    if not broken:
        return f"The promise is kept on {rows} {how}: the model leaves {left}; promised: {limits}."
    which = " and the ".join(broken)
    return f"The promise of the {which} is not kept on {rows} {how}: the model leaves {left}; promised: {limits}."


def verify_tables(results: VerifyResults) -> list[Table]:
    """Pose error against the promise, and the deviation of each joint."""
    rows = []
    for kind in results.kinds:
        block = results[kind]
        scale, unit = display_unit(block.unit, block.before.rms)
        for when in ("before", "after"):
            cells = [number_text(block[when][measure] / scale) for measure in ("rms", "max")]
            rows.append((f"{kind} {when} [{unit}]", *cells, *_promise_cells(block, scale, when)))
    frames = f"Measuring frame: {results.frames}."
    note = (
        "Promised: RMS of the rows that were held out when the model was made. New rows like those pass the limit once "
        f"in twenty. {frames}"
    )
    columns = ("", "RMS", "maximum", "promised RMS", "limit at 95 %")
    pose = Table("Pose error of the new rows", columns, rows, note)
    joints = []
    for name, block in results.joints.items():
        scale, unit = display_unit(block.unit, block.before or 0.0)
        cells = [number_text(None if block[w] is None else block[w] / scale) for w in ("before", "after")]
        joints.append((f"{name} [{unit}]", *cells))
    about = "RMS, at the commanded joints; rows near singular poses or out of reach are left out."
    tables = [pose, Table("Deviation of each joint", ("joint", "before", "after"), joints, about)]
    again = results.repeated
    if again is not None:
        scale, unit = display_unit("m", again.accuracy.median)
        lines = [
            (f"{words} [{unit}]", *(number_text(value / scale) for value in (found.median, found.max)))
            for words, found in (
                ("accuracy AP before", again.accuracy),
                ("accuracy AP after", again.accuracy_after),
                ("repeatability RP", again.repeatability),
            )
        ]
        note = (
            f"ISO 9283, position: {count_text(again.targets, 'target')} with {again.cycles} readings or more. RP is "
            "the mean distance from the target's own mean and three standard deviations; no model makes it smaller."
        )
        tables.append(Table("Targets that were reached again", ("", "median", "largest"), lines, note))
    return tables


def _left(block: Error, kind: str) -> str:
    after, before = (with_unit(block[when].rms, block.unit, like=block.before.rms) for when in ("after", "before"))
    return f"{after} RMS of {kind} (before {before})"


def _limit(block: Error, promised: Promised, kind: str) -> str:
    rms, high = (with_unit(value, block.unit, like=block.before.rms) for value in (promised.rms, promised.high))
    return f"{rms}, at most {high} at 95 % ({kind})"


def _promise_cells(block: Error, scale: float, when: str) -> tuple[str, str]:
    if when == "before" or block.promised is None:
        return "–", "–"
    rms, high = (number_text(block.promised[key] / scale) for key in ("rms", "high"))
    return rms, high
