"""Report of a run and its figures; curves of training and masks are in TensorBoard's files."""

from __future__ import annotations

from pathlib import Path

from ccnn_torch.calibration.page import run_page, write_tables
from ccnn_torch.report.arrays import ARRAYS_FILE, load_arrays
from ccnn_torch.report.figures import (
    Plot,
    inline_figures,
    joint_error_plot,
    pose_error_plot,
    workspace_plot,
)
from ccnn_torch.report.machine import machine_plot
from ccnn_torch.report.results.run import RunResults

_LINKED = ("results.json", "results.csv", "card.json", "model.safetensors", "model.onnx", "config.yaml")


def write_report(folder: str | Path, results: RunResults | None = None) -> Path:
    """Write `results.csv`, `results.md`, `plots/` and `report.html` of a run folder.

    Reads `arrays.safetensors` where it is there; the same files give the same report, so it can be written again at any
    time.

    Args:
        results: the content of its `results.json`, which is read when None.

    Returns:
        The path of `report.html`.
    """
    folder = Path(folder)
    results = RunResults.read(folder / "results.json") if results is None else results
    write_tables(folder, results)
    figures = inline_figures(run_plots(folder, results), folder / "plots")
    return run_page(results, figures, Path(folder.name)).write_html(folder / "report.html", _LINKED)


def run_plots(folder: str | Path, results: RunResults) -> list[Plot]:
    """All pictures of a run folder, in reading order; a picture whose data is not there is left out."""
    folder = Path(folder)
    plots: list[Plot | None] = []
    if (folder / ARRAYS_FILE).is_file():
        arrays = load_arrays(folder)
        words = "With " + " + ".join([*results.pose.parts, arrays.labels.get("method", "the model")])
        # What mostly turns has no places to draw errors at, but a map of its angles.
        plots.append(machine_plot(arrays.drawn, words) or workspace_plot(arrays))
        plots += [pose_error_plot(arrays), joint_error_plot(arrays)]
    return [plot for plot in plots if plot is not None]
