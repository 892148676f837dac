"""One HTML file that opens anywhere, offline: tables and inline SVG, no script, nothing fetched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ccnn_torch.report.table import Table


class InlineFigure(NamedTuple):
    """A figure on the page: its name (the id), one sentence, and an `<svg>` element made by this package."""

    name: str
    caption: str
    svg: str


def page_text(
    template: str,
    results: Mapping[str, Any],
    verdict: str,
    tables: Sequence[Table],
    failures: Sequence[str],
    figures: Sequence[InlineFigure],
    config: str,
    files: Sequence[str],
    best: str | None = None,
    worse: bool = False,
) -> str:
    """A page: verdict, sentences about what failed, tables, figures, notes, files, configuration, versions.

    Args:
        template: `report` or `identified`.
        best: first cell of the rows that are set in bold.
        worse: whether the verdict is no success, and is not marked as one.
    """
    return render(
        template,
        results=results,
        verdict=verdict,
        tables=tables,
        failures=failures,
        figures=trusted(figures),
        config=config,
        files=files,
        best=best,
        worse=worse,
    )


def render(template: str, **values: Any) -> str:
    """Fill a page's template in; a name in it that no value has is an error.

    Args:
        template: the file's name before `.html.jinja`.
        values: what the template asks for; everything but `Markup` is escaped.
    """
    environment = Environment(
        loader=PackageLoader("ccnn_torch.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(f"{template}.html.jinja").render(**values)


def trusted(figures: Sequence[InlineFigure]) -> list[InlineFigure]:
    """Figures whose SVG is not escaped, since this package made it; everything else on a page is."""
    return [figure._replace(svg=Markup(figure.svg)) for figure in figures]
