"""From `diagnosis.json` and its arrays to terminal, Markdown, pictures and one HTML page; and that of `ccnn check`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from ccnn_torch.diagnosis.checks.identifiable import Check
from ccnn_torch.diagnosis.page.data import (
    ARRAYS,
    CORRECTED,
    LABELS,
    NEXT,
    RESULT,
    About,
    about_of,
    load_labels,
    signatures_of,
    used_rows,
)
from ccnn_torch.diagnosis.page.first_screen import ON_PAGE, ON_SCREEN, cards, first_screen
from ccnn_torch.diagnosis.page.tables import (
    aside_table,
    confusable_table,
    effect_table,
    gap_table,
    next_table,
    order_table,
    record_table,
    region_table,
    unseen_table,
    where_table,
)
from ccnn_torch.diagnosis.verdict.text import aside_text, listed, network_text, size_text, unseen_text, verdict_text
from ccnn_torch.display import count_text
from ccnn_torch.effects import OUTLIER
from ccnn_torch.effects.words import words_of
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.arrays import load_tensors, save_tensors
from ccnn_torch.report.json_files import read_json, write_json
from ccnn_torch.report.page import InlineFigure, Page, Section
from ccnn_torch.report.table import Table, print_text

if TYPE_CHECKING:
    from ccnn_torch.report.figures import Plot

Block = Mapping[str, Any]
Arrays = Mapping[str, NDArray[np.float64]]
_MARKDOWN = "diagnosis.md"
_FILES = (RESULT, _MARKDOWN, NEXT, *CORRECTED, ARRAYS, LABELS)
# Rows set aside that a terminal lists.
_NAMED = 5
# On a terminal only what may matter; the page and the Markdown list every candidate.
_LEAST = 0.01


def write_diagnosis_report(
    folder: str | Path,
    results: Block | None = None,
    arrays: Mapping[str, Tensor] | None = None,
    labels: Block | None = None,
) -> Path:
    """Write `report.html`, `diagnosis.md` and `plots/`.

    The same files give the same report, so it can be written again at any time. A picture or a table whose numbers are
    not there is left out.

    Args:
        folder: where to write; with `diagnosis.json`, `diagnosis.safetensors` and `diagnosis_pictures.json`.
        results: the content of `diagnosis.json`, which is read when None.
        arrays: what is drawn in the figures (`s` rows in the order of the file, `c` pose channels, float64, SI):
            `place` `s x 3`, `joints` `s x n`, `residual` and `remainder` `s x c`, `held_out` and `set_aside` `s`, the
            arrays of `report.machine`, and `signature.EFFECT.x`, `.y` and `.fit` `s`; written to
            the folder first, or read from it when None. Of a motion what `course_plot` takes.
        labels: names and units of the signatures' axes, `{EFFECT: {"x": {"name", "unit"}, "y": …}}`, and under `about`
            what `About` holds; written or read like the arrays.

    Returns:
        The path of `report.html`.

    Raises:
        InputError: a file is not there or damaged.
    """
    folder = Path(folder)
    results = read_json(folder / RESULT) if results is None else results
    if arrays is not None:
        save_tensors(folder / ARRAYS, arrays)
        write_json(folder / LABELS, labels or {})
    numbers, labels = load_tensors(folder / ARRAYS)[0], load_labels(folder)
    about = about_of(labels)
    # Here, so that `ccnn check` and the verdict on the terminal do not wait for matplotlib.
    from ccnn_torch.report.figures import inline_figures

    write_whole(folder / _MARKDOWN, diagnosis_page(results, about).markdown())
    figures = inline_figures(_plots(results, numbers, labels, about), folder / "plots")
    return diagnosis_page(results, about, numbers, figures).write_html(folder / "report.html", _FILES)


def diagnosis_page(
    results: Block,
    about: About | None = None,
    arrays: Arrays | None = None,
    figures: Sequence[InlineFigure] = (),
    screen: bool = False,
) -> Page:
    """All that a diagnosis shows.

    Args:
        results: as in `diagnosis.json`.
        about: for names, units and paths.
        arrays: as `write_diagnosis_report` takes them.
        figures: of the page.
        screen: for a terminal: fewer rows, doubts and rows set aside in sentences, and without the verdict.
    """
    about, arrays = about or About(), arrays or {}
    named = {figure.name: figure for figure in figures}
    machine = [named["machine"]] if "machine" in named else []
    answers = first_screen(results, about, ON_SCREEN if screen else ON_PAGE)
    found = cards(results) if figures else []
    if figures:
        # Cards have what is wrong and what to look at, tables what the lines have.
        answers = [a if a.table is None else a._replace(commands=()) for a in answers]
        answers = [a for a in answers if not found or a.label not in ("What is wrong", "Look at")]
    aside = results["rows_set_aside"]
    why = results.get("why_set_aside") or ["for an unknown reason"] * len(aside)
    left_out = aside_text(aside, why, about.lines)
    if len(aside) > _NAMED:
        counted = listed([f"{number} {reason}" for reason, number in Counter(why).items()])
        left_out = f"{len(aside)} rows set aside: {counted}; the report lists them."
    doubts = [f"But {caution}." for caution in results.get("cautions", ())]
    return Page(
        name=about.name,
        kind="diagnosis of the gap",
        verdict="" if screen else verdict_text(results),
        sections=[
            Section("What is wrong" if found else "", figures=machine, answers=answers, cards=found),
            *_sections(results, arrays, about, named, screen),
        ],
        facts=_facts(results, arrays, about),
        cautions=[*doubts, *filter(None, [left_out])] if screen else [],
        notes=_notes(results, about),
    )


def print_diagnosis(
    results: Block, console: Console, about: About | None = None, *, begun: bool = False, details: bool = False
) -> None:
    """Show on a terminal what a technician needs first.

    Args:
        results: as in `diagnosis.json`.
        console: where.
        about: for names, units and paths.
        begun: what is wrong was shown before.
        details: show the verdict in two sentences, notes and tables as well, before it.
    """
    page = diagnosis_page(results, about, screen=True)
    if details:
        print_text(verdict_text(results), console)
    else:
        first, *rest = page.sections
        answers = [a for a in first.answers[begun:] if a.label != "Fitted frames"]
        page = replace(page, sections=[replace(first, answers=answers), *rest])
    page.show(console, details)


def _notes(results: Block, about: About) -> list[str]:
    """Notes as sentences, but those that have a table of their own."""
    shown = {unseen_text(name, why) for name, why in results.get("not_seen", {}).items()}
    notes = (note for note in (*results["notes"], *about.notes) if note not in shown)
    return [note if note.endswith(".") else f"{note}." for note in notes]


def _plots(results: Block, arrays: Arrays, labels: Block, about: About) -> list[Plot]:
    from ccnn_torch.diagnosis.page.figures import course_plot, remainder_map, signature_plot
    from ccnn_torch.report.machine import machine_plot

    effects = list(results["verdict"]["effects"])
    found = [words_of(name).short for name in effects if name != OUTLIER]
    words = found[0] if len(found) == 1 else f"the {len(found)} effects"
    plots = (
        course_plot(results, arrays),
        machine_plot(arrays, f"With {words} in it" if found else "What is left"),
        signature_plot(signatures_of(arrays, labels, effects), arrays, effects),
        remainder_map(arrays, about),
    )
    return [plot for plot in plots if plot is not None]


def _sections(
    results: Block, arrays: Arrays, about: About, figures: Mapping[str, InlineFigure], screen: bool
) -> list[Section]:
    """The page in reading order; a section with nothing to show is left out."""
    order = order_table(results)
    effects = effect_table(results, least=_LEAST if screen else 0.0)
    where = where_table(results, about, telling=screen)
    planned: list[tuple[str, tuple[str, ...], tuple[Table | None, ...]]] = [
        ("How large is the gap?", (), (gap_table(results, about), order)),
        ("Which effect?", (), (effects,)),
        ("What gives it away?", ("signatures",), ()),
        ("Where is the gap?", ("map", "course"), (where, region_table(results, about))),
        ("Which effects do these rows not distinguish?", (), (confusable_table(results),)),
        ("What can these records not show?", (), (unseen_table(results), record_table(results))),
        ("What should be measured next?", (), (next_table(results, about),)),
        ("Which rows were set aside?", (), (aside_table(results, arrays, about),)),
    ]
    sections = []
    for title, names, tables in planned:
        shown = [figures[name] for name in names if name in figures]
        there = [table for table in tables if table is not None]
        if shown or there:
            sections.append(Section(title, there, shown))
    if order is None:
        # No table has what a network would gain.
        sections[0] = replace(sections[0], sentences=[*filter(None, [network_text(results)])])
    return sections


def _facts(results: Block, arrays: Arrays, about: About) -> str:
    facts = [text for text in (about.mechanism, about.records) if text]
    if "residual" in arrays:
        held, aside = used_rows(arrays, len(arrays["residual"]))
        facts.append(count_text(len(held), "row"))
        if (held | aside).all():
            facts.append("each judged by a fit to other rows")
        elif held.any():
            facts.append(f"{int((held & ~aside).sum())} of them not used for fitting")
    if results["rows_set_aside"]:
        facts.append(f"{len(results['rows_set_aside'])} set aside")
    return " · ".join(facts)


# Confusable effects shown for each effect.
_LIKEST = 3


def check_text(check: Check) -> list[str]:
    """What the records can and cannot show, one sentence a line."""
    units = {name: {"unit": "rad" if name.startswith("r") else "m"} for name in check.noise}
    noise = ", ".join(f"{name} {size_text(size, units[name], 2)}" for name, size in check.noise.items())
    lines = [
        f"{check.rows} rows, {len(check.aside)} of them set aside; condition number of the Jacobian up to "
        f"{check.condition:.3g}.",
        f"Noise, {'as given' if check.noise_given else 'estimated'}: {noise}.",
        f"Covariates: {', '.join(check.covariates) or 'none'}.",
    ]
    lines += [aside_text(check.aside, check.why_aside, check.lines_aside)] if check.aside else []
    lines += [f"{remark}." for remark in check.remarks]
    lines += [f"Caution: {caution}." for caution in check.cautions]
    reasons: dict[str, list[str]] = {}
    for name, why in check.missing.items():
        reasons.setdefault(why, []).append(name)
    lines += [f"{unseen_text(listed(names), why)}." for why, names in reasons.items()]
    if check.weak:
        sizes = [f"{name} ({size:.2g} of it)" for name, size in check.weak.items()]
        lines.append(f"{listed(sizes)} could hide in the noise: that large each plausibly is.")
    if check.confusable:
        alike = len({first for first, _, _ in check.confusable})
        lines.append(f"{alike} effects do nearly what others can do on these rows; --details lists them.")
    return lines


def check_table(check: Check) -> Table:
    """What could take over each effect on these rows, the closest first."""
    found: dict[str, list[str]] = {}
    for first, second, share in check.confusable:
        found.setdefault(first, []).append(f"{second} {share:.3f}")
    rows = tuple(
        (name, ", ".join(others[:_LIKEST]) + (f" and {more} more" if (more := len(others) - _LIKEST) > 0 else ""))
        for name, others in found.items()
    )
    note = (
        "1.000: on these rows the other does all that the effect does (cosine of the two). A diagnosis still tells "
        "them apart where the other needs implausible or more numbers; all pairs are in check.json (--out)."
    )
    return Table(
        "Effects that look alike on these rows", ("effect", "can be taken for"), rows, note, ("can be taken for",)
    )
