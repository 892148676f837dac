"""From an identification's folder to its pictures and its HTML page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.identification.page.tables import identified_page
from ccnn_torch.report.arrays import ARRAYS_FILE, load_tensors
from ccnn_torch.report.json_files import read_json

_LINKED = (
    "identified.json",
    "identified.csv",
    "identified.md",
    "identified.yaml",
    "identified_dh.yaml",
    "identified.urdf",
    "config.yaml",
)


def write_identified_report(folder: str | Path, results: Mapping[str, Any] | None = None) -> Path:
    """Write `plots/` and `report.html`; the same files give the same report, so it can be written again at any time.

    Args:
        folder: with arrays, and `identified.json`, which is read when `results` is None.
    """
    # Loads matplotlib, which only a report waits for.
    from ccnn_torch.identification.page.figures import identified_plots
    from ccnn_torch.report.figures.style import inline_figures

    folder = Path(folder)
    results = read_json(folder / "identified.json") if results is None else results
    arrays = load_tensors(folder / ARRAYS_FILE)[0]
    figures = inline_figures(identified_plots(results, arrays), folder / "plots")
    return identified_page(results, figures).write_html(folder / "report.html", _LINKED)
