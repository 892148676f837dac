"""What the pages of poses and of motions share: one HTML page, the same as Markdown, and the first screen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console

from ccnn_torch.diagnosis.page.data import ARRAYS, CORRECTED, LABELS, NEXT, RESULT, About
from ccnn_torch.diagnosis.page.first_screen import ON_PAGE, first_screen, first_screen_markdown, print_first_screen
from ccnn_torch.diagnosis.page.numbers import numbers_table
from ccnn_torch.diagnosis.verdict.text import unseen_text, verdict_text
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.html import InlineFigure, render, trusted
from ccnn_torch.report.table import Table, markdown_table, print_text

if TYPE_CHECKING:
    from ccnn_torch.report.figures.style import Plot

__all__ = ["Section", "markdown_of", "notes_of", "print_page", "sections_of", "write_page"]

Block = Mapping[str, Any]
Planned = Sequence[tuple[str, tuple[str, ...], tuple[Table | None, ...]]]
_MARKDOWN = "diagnosis.md"
_FILES = (RESULT, _MARKDOWN, NEXT, *CORRECTED, ARRAYS, LABELS)


class Section(NamedTuple):
    """A heading of the page with the pictures and the tables that answer it."""

    title: str
    figures: list[InlineFigure]
    tables: list[Table]


def write_page(
    folder: Path,
    results: Block,
    about: About,
    sections: Callable[[Mapping[str, InlineFigure]], list[Section]],
    plots: Sequence[Plot],
    facts: str,
    notes: Sequence[str],
    markdown: str,
) -> dict[str, Path]:
    """Write `report.html`, `diagnosis.md` and `plots/`; the pictures by name.

    Args:
        folder: where to.
        results: the content of `diagnosis.json`.
        about: names and units.
        sections: of the page, with the figures by name.
        plots: what they are drawn of.
        facts: the line below the title.
        notes: sentences at the end.
        markdown: as of `markdown_of`.
    """
    from ccnn_torch.report.figures.style import inline_svg, save_figure

    write_whole(folder / _MARKDOWN, markdown)
    figures, pictures = {}, {}
    for plot in plots:
        png, svg = save_figure(plot.figure, folder / "plots" / plot.name)
        text = inline_svg(svg.read_text(encoding="utf-8"), plot.name)
        figures[plot.name], pictures[plot.name] = InlineFigure(plot.name, plot.caption, text), png
    page = render(
        "diagnosis",
        results={"name": about.name, "notes": notes, "versions": {}},
        facts=facts,
        verdict=verdict_text(results),
        failures=[],
        answers=first_screen(results, about),
        numbers=numbers_table(results, ON_PAGE),
        machine=trusted([figures[name] for name in ("machine",) if name in figures]),
        sections=sections(figures),
        files=[
            f for f in (RESULT, _MARKDOWN, NEXT, *CORRECTED, ARRAYS, LABELS) if f == RESULT or (folder / f).is_file()
        ],
        config="",
        best=None,
    )
    write_whole(folder / "report.html", page)
    return pictures


def sections_of(planned: Planned, figures: Mapping[str, InlineFigure]) -> list[Section]:
    """The page in reading order: title, names of figures, tables; a section with nothing to show is left out."""
    sections = []
    for title, names, tables in planned:
        shown = [figures[name] for name in names if name in figures]
        there = [table for table in tables if table is not None]
        if shown or there:
            sections.append(Section(title, trusted(shown), there))
    return sections


def markdown_of(results: Block, about: About, sections: Sequence[Section], notes: Sequence[str]) -> str:
    """Verdict and tables as Markdown."""
    tables = [markdown_table(table) for section in sections for table in section.tables]
    first = [verdict_text(results), *first_screen_markdown(results, about)]
    return "\n\n".join([f"# {about.name}", *first, *tables, *notes]) + "\n"


def print_page(
    results: Block,
    console: Console,
    about: About,
    verdict: bool,
    tables: Callable[[], None] | None,
    sentences: Sequence[str],
) -> None:
    """Show on a terminal what a technician needs first; tables: shows them, None = they are not wanted."""
    if verdict:
        print_text(verdict_text(results), console, "bold")
    print_first_screen(results, console, about)
    if tables is not None:
        tables()
    for sentence in sentences:
        print_text(sentence, console, "yellow")
    if tables is None:
        said = "All tables are in report.html, diagnosis.md and diagnosis.json; --details shows them here."
        print_text(said, console, "dim")


def notes_of(results: Block, *more: str) -> list[str]:
    """Notes as sentences, but those that have a table of their own."""
    shown = {unseen_text(name, why) for name, why in results.get("not_seen", {}).items()}
    return [note if note.endswith(".") else f"{note}." for note in (*results["notes"], *more) if note not in shown]
