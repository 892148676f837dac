"""What a job shows, once for the terminal, Markdown and HTML: sections with answers, tables, figures and sentences.

A job makes a `Page`; `show` prints it, `markdown` and `html` give the text of a file. The HTML is one file that opens
anywhere, offline: tables and inline SVG, no script, nothing fetched.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from ccnn_torch.display import count_text
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.table import Table, markdown_table, print_labelled, print_table, print_text


class InlineFigure(NamedTuple):
    """A figure on the page: its name (the id), one sentence, and an `<svg>` element made by this package."""

    name: str
    caption: str
    svg: str


class Answer(NamedTuple):
    """What is asked, sentences that answer it, and the lines to copy and the table that go with it."""

    label: str
    text: str
    commands: tuple[str, ...] = ()
    table: Table | None = None


class Card(NamedTuple):
    """One thing that was found: its title, what it is, the numbers to enter, and what to look at."""

    title: str
    text: str
    numbers: tuple[str, ...] = ()
    look: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a page; HTML has its title above its figures, its tables have their own."""

    title: str = ""
    tables: Sequence[Table] = ()
    figures: Sequence[InlineFigure] = ()
    answers: Sequence[Answer] = ()
    sentences: Sequence[str] = ()
    cards: Sequence[Card] = ()

    def show(self, console: Console, details: bool = True) -> None:
        """Print it without figures and cards, and without `details` the answers alone; no line to copy is wrapped."""
        for answer in self.answers:
            print_labelled(answer.label, answer.text, console)
            for command in answer.commands:
                print_text(f"  {command}", console, wrap=False)
            if details and answer.table is not None:
                print_table(answer.table, console)
        if not details:
            return
        for table in self.tables:
            print_table(table, console)
        for sentence in self.sentences:
            print_text(sentence, console, "yellow")

    def markdown(self) -> list[str]:
        """Its paragraphs without its figures, the tables of answers below all of them."""
        parts = []
        for answer in self.answers:
            code = "".join(f"\n\n    {command}" for command in answer.commands)
            parts.append(f"**{answer.label}:** {answer.text}{code}")
        tables = [*(answer.table for answer in self.answers if answer.table is not None), *self.tables]
        return [*parts, *map(markdown_table, tables), *self.sentences]


def sections_of(
    tables: Iterable[Table | None], figures: Sequence[InlineFigure] = (), answers: Sequence[Answer] = ()
) -> list[Section]:
    """The first figure with the answers, a section for each table that is there, and one for all other figures."""
    first = [Section(figures=figures[:1], answers=answers)] if answers else []
    found = [*first, *(Section(table.title, (table,)) for table in tables if table is not None)]
    rest = figures[1:] if answers else figures
    return [*found, Section("Figures", figures=rest)] if rest else found


@dataclass(frozen=True)
class Page:
    """What a job shows.

    Attributes:
        name: title of the page.
        kind: what it is, behind the title.
        verdict: one or two sentences.
        sections: in reading order.
        facts: one line below the title.
        cautions: what a user must know beside the verdict, one sentence each.
        notes: further sentences.
        versions: of packages.
        best: first cell of the rows that are set in bold.
        worse: whether the verdict is no success, and is not marked as one.
    """

    name: str
    kind: str
    verdict: str
    sections: Sequence[Section]
    facts: str = ""
    cautions: Sequence[str] = ()
    notes: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    best: str | None = None
    worse: bool = False

    def show(self, console: Console, details: bool = True, where: str = "the report") -> None:
        """Print the tables and notes if there are to be `details`, then what matters: verdict, answers and cautions.

        where: tables and notes are else.
        """
        if details:
            for section in self.sections:
                replace(section, answers=()).show(console)
            for note in self.notes:
                print_text(note, console, "dim")
        if self.verdict:
            print_text(self.verdict, console, "bold")
        for section in self.sections:
            replace(section, tables=(), sentences=()).show(console, details)
        for sentence in self.cautions:
            print_text(sentence, console, "yellow")
        if not details:
            rest = f"Tables and {count_text(len(self.notes), 'note')}" if self.notes else "Tables"
            print_text(f"{rest} are in {where}; --details shows them here.", console, "dim")

    def markdown(self) -> str:
        """Title, verdict, cautions, sections and notes."""
        parts = [part for section in self.sections for part in section.markdown()]
        return (
            "\n\n".join([f"# {self.name}", *filter(None, (self.verdict, *self.cautions)), *parts, *self.notes]) + "\n"
        )

    def html(self, files: Sequence[str] = (), config: str = "") -> str:
        """The page as one HTML file.

        Args:
            files: names that it links to.
            config: text of the configuration.
        """
        from jinja2 import Environment, PackageLoader, StrictUndefined
        from markupsafe import Markup

        environment = Environment(
            loader=PackageLoader("ccnn_torch.report", "."),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        # All text is escaped but the SVG, which this package made.
        template = environment.get_template("page.html.jinja")
        return template.render(page=self, files=files, config=config, trusted=Markup)

    def write_html(self, path: Path, files: Sequence[str] = ()) -> Path:
        """Write the page with the config that is beside it, and links to those of the files that are.

        The first one is the result, which is written last.
        """
        config = path.with_name("config.yaml")
        text = config.read_text(encoding="utf-8") if config.is_file() else ""
        there = [name for name in files if name == files[0] or path.with_name(name).is_file()]
        write_whole(path, self.html(there, text))
        return path
