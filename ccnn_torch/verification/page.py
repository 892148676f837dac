"""The page of `ccnn verify`: its sentences, tables and figures, from the content of `verify.json`."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.page import Page, sections_of
from ccnn_torch.report.results.verify import Error, Promised, VerifyResults
from ccnn_torch.report.table import Table


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


_KINDS = ("position", "rotation")


def verify_text(results: VerifyResults) -> str:
    """The verdict in one or two sentences."""
    blocks = {kind: results[kind] for kind in _KINDS if results[kind] is not None}
    promised = {kind: block for kind, block in blocks.items() if block.promised is not None}
    rows = count_text(results.rows, "row")
    how = "measured with the model in use" if results.compensated else "measured without compensation"
    left = " and ".join(_left(block, kind) for kind, block in blocks.items())
    if not promised:
        verdict = "is lower" if results.kept else "is not lower"
        return (
            f"The model promises no figure; on {rows} {how} the position error {verdict} than before at 95 %: {left}."
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
    for kind in _KINDS:
        block = results[kind]
        if block is None:
            continue
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
    scale, unit = display_unit(block.unit, block.before.rms)
    after, before = (number_text(block[when].rms / scale, 3) for when in ("after", "before"))
    return f"{after} {unit} RMS of {kind} (before {before} {unit})"


def _limit(block: Error, promised: Promised, kind: str) -> str:
    scale, unit = display_unit(block.unit, block.before.rms)
    rms, high = (number_text(value / scale, 3) for value in (promised.rms, promised.high))
    return f"{rms} {unit}, at most {high} {unit} at 95 % ({kind})"


def _promise_cells(block: Error, scale: float, when: str) -> tuple[str, str]:
    if when == "before" or block.promised is None:
        return "–", "–"
    rms, high = (number_text(block.promised[key] / scale) for key in ("rms", "high"))
    return rms, high
