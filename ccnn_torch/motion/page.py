"""The report of a diagnosis of motion: first screen, tables and figures as for poses, and the course over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from ccnn_torch.diagnosis.page.data import (
    NEXT,
    RESULT,
    About,
    about_of,
    load_diagnosis_arrays,
    load_labels,
    save_diagnosis_arrays,
)
from ccnn_torch.diagnosis.page.layout import Section, markdown_of, notes_of, print_page, sections_of, write_page
from ccnn_torch.diagnosis.page.tables import (
    confusable_table,
    effect_table,
    gap_table,
    order_table,
    parameter_table,
    unseen_table,
)
from ccnn_torch.display import number_text
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.html import InlineFigure
from ccnn_torch.report.json_files import read_json
from ccnn_torch.report.table import Table, print_table

if TYPE_CHECKING:
    from ccnn_torch.motion.next_motion import Motion

__all__ = ["print_motion", "write_motion_report", "write_next_motion"]

Block = Mapping[str, Any]
Arrays = Mapping[str, NDArray[np.float64]]
_LEAST = 0.01


def write_motion_report(
    folder: Path,
    results: Block | None = None,
    arrays: Mapping[str, Tensor] | None = None,
    labels: Block | None = None,
) -> Path:
    """Write `report.html`, `diagnosis.md` and `plots/`; the same files give the same report.

    Args:
        folder: with `diagnosis.json`.
        results: its content, read when None.
        arrays: what is drawn, as of `motion_arrays`; read from the folder when None.
        labels: `about`, as for a diagnosis of poses; read when None.

    Raises:
        InputError: a file is not there or damaged.
    """
    from ccnn_torch.diagnosis.page.figures import gap_plot, probability_plot
    from ccnn_torch.motion.figure import course_plot

    results = read_json(folder / RESULT) if results is None else results
    if arrays is not None:
        save_diagnosis_arrays(folder, arrays, labels or {})
    numbers, about = load_diagnosis_arrays(folder), about_of(load_labels(folder))
    plots = [gap_plot(results), probability_plot(results), course_plot(results, numbers)]
    write_page(
        folder,
        results,
        about,
        lambda figures: _sections(results, about, figures),
        [plot for plot in plots if plot is not None],
        " · ".join(text for text in (about.mechanism, about.records) if text),
        notes_of(results),
        markdown_of(results, about, _sections(results, about, {}), notes_of(results)),
    )
    return folder / "report.html"


def write_next_motion(path: Path, motions: list[Motion], entries: list[Block], unit: str) -> None:
    """Write the commands of the first proposed motion: `time[s]` and its joint's command, to be played.

    Args:
        path: of the file.
        motions: proposed, the best first.
        entries: `next_measurements` of diagnosis.json.
        unit: of the joints.
    """
    if not motions:
        return
    number = str(entries[0]["motion"]["joint"]).removeprefix("q")
    rows = zip(motions[0].time.tolist(), motions[0].command.tolist(), strict=True)
    write_rows(path, ["time[s]", f"command{number}[{unit}]"], [list(row) for row in rows])


def print_motion(
    results: Block, console: Console, about: About | None = None, *, verdict: bool = True, details: bool = False
) -> None:
    """Show on a terminal what a technician needs first; arguments as of `print_diagnosis`."""
    about = about or About()

    def tables() -> None:
        for section in _sections(results, about, {}, _LEAST):
            for table in section.tables:
                print_table(table, console)

    print_page(results, console, about, verdict, tables if details else None, notes_of(results))


def _sections(results: Block, about: About, figures: Mapping[str, InlineFigure], least: float = 0.0) -> list[Section]:
    planned: list[tuple[str, tuple[str, ...], tuple[Table | None, ...]]] = [
        ("How large is the gap?", ("gap",), (gap_table(results, about), order_table(results))),
        ("Which effect?", ("probabilities",), (effect_table(results, least=least), parameter_table(results))),
        ("Where and when is the gap?", ("course",), (_phase_table(results),)),
        ("Which effects do these runs not distinguish?", (), (confusable_table(results),)),
        ("What can these logs not show?", (), (unseen_table(results),)),
        ("What should be recorded next?", (), (_next_table(results),)),
    ]
    return sections_of(planned, figures)


def _phase_table(results: Block) -> Table | None:
    """Shares of the gap by joint and by phase of the motion."""
    where, known = results["where"], results.get("where_ci95", {})
    rows = []
    for name, share in where["joints"].items():
        rows.append((f"joint {name.removeprefix('q')}", *_share(share, known.get("joints", {}).get(name)), "–"))
    for name, block in where.get("phases", {}).items():
        share, samples = block["share"], f"{100 * block['samples']:.0f}"
        rows.append((name, *_share(share, known.get("phases", {}).get(name)), samples))
    columns = ("part", "share of the gap [%]", "95 % interval [%]", "share of the time [%]")
    note = (
        "Share: of the gap's mean square. Phases by the measured speed; reversal: 0.15 s around a change of direction."
    )
    return Table("Where is the gap?", columns, tuple(rows), note) if rows else None


def _share(share: float, interval: list[float] | None) -> tuple[str, str]:
    ends = "–" if interval is None else f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"
    return f"{100 * share:.1f}", ends


def _next_table(results: Block) -> Table | None:
    rows = tuple(
        (
            str(k),
            e["motion"]["joint"],
            e["motion"]["text"],
            " or ".join(e["separates"]) or "–",
            number_text(e["gain"], 3),
        )
        for k, e in enumerate(results["next_measurements"], 1)
    )
    note = (
        "Gain: expected log odds by which the motion tells the two apart, or where there is no rival the information "
        f"on the numbers of the only model. The first as commands to play: {NEXT}."
    )
    columns = ("number", "joint", "motion", "separates", "gain [nat]")
    return Table("What should be recorded next?", columns, rows, note, ("motion", "separates")) if rows else None
