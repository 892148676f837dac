"""Write the page of `ccnn verify` with its figures."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from ccnn_torch.display import count_text
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.page import Page, sections_of
from ccnn_torch.report.results.verify import VerifyResults
from ccnn_torch.verification.tables import verify_tables


def write_verify_report(folder: Path, results: VerifyResults, arrays: RunArrays) -> list[Path]:
    """Write `verify.html` and `verify.json` into a folder, which is made."""
    # Imported here: it loads matplotlib.
    from ccnn_torch.report.figures.errors import joint_error_plot, pose_error_plot
    from ccnn_torch.report.figures.style import inline_figures
    from ccnn_torch.verification.figure import pose_rows_plot, predicted_plot

    plots = [pose_rows_plot(arrays), pose_error_plot(arrays), joint_error_plot(arrays)]
    if not results.compensated:
        plots.insert(0, predicted_plot(arrays))
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
