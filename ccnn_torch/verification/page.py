"""Write the page of `ccnn verify` with its figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ccnn_torch.files.write import write_whole
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.html import page_text
from ccnn_torch.report.json_files import write_json
from ccnn_torch.verification.tables import verify_tables


def write_verify_report(folder: Path, results: Mapping[str, Any], arrays: RunArrays) -> list[Path]:
    """Write `verify.html` and `verify.json` into a folder, which is made."""
    # Imported here: it loads matplotlib.
    from ccnn_torch.report.figures.errors import joint_error_plot, pose_error_plot
    from ccnn_torch.report.figures.style import inline_figures
    from ccnn_torch.verification.figure import pose_rows_plot, predicted_plot

    plots = [pose_rows_plot(arrays), pose_error_plot(arrays), joint_error_plot(arrays)]
    if not results["compensated"]:
        plots.insert(0, predicted_plot(arrays))
    with TemporaryDirectory() as scratch:
        figures = [
            figure._replace(caption=figure.caption.replace("held-out row", "new row"))
            for figure in inline_figures(plots, Path(scratch))
        ]
    page = page_text(
        "verify",
        {"name": f"{results['model']} on {results['records']}", "versions": {}, **results},
        results["text"],
        verify_tables(results),
        [],
        figures,
        "",
        ["verify.json"],
    )
    write_whole(folder / "verify.html", page.encode())
    write_json(folder / "verify.json", results)
    return [folder / "verify.json", folder / "verify.html"]
