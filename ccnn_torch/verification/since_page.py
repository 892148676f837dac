"""The folder of `ccnn diagnose --since`: `since.json`, its page, and the poses to measure next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.page.data import NEXT, About
from ccnn_torch.diagnosis.page.tables import quantity_text, write_next_csv
from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.page import Answer, Page, sections_of
from ccnn_torch.report.results.since import SinceResults
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
            scale, unit = display_unit(one.unit, abs(one.value))
            value, sd = (number_text(v / scale, 3) for v in (one.value, one.sd))
            numbers.append((told.text, one.name, f"{value} {unit}", f"{sd} {unit}", " or ".join(told.instead) or "–"))
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
    rows = []
    for change in results.changes:
        scale, unit = display_unit(change.unit, change.seen_from)
        size = "–" if change.seen_from is None else f"{number_text(change.seen_from / scale, 2)} {unit}"
        rows.append((change.text, number_text(change.probability, 2), size))
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
