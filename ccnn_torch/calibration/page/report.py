"""Write the tables, figures and HTML page of a run folder."""

from __future__ import annotations

from pathlib import Path

from ccnn_torch.calibration.page.figures import convergence_plot, network_plot, population_plot, progress_plot
from ccnn_torch.calibration.page.tables import run_page, write_tables
from ccnn_torch.errors import InputError
from ccnn_torch.report.arrays import ARRAYS_FILE, load_arrays, load_history
from ccnn_torch.report.figures.errors import joint_error_plot, pose_error_plot
from ccnn_torch.report.figures.style import Plot, inline_figures, save_figure
from ccnn_torch.report.figures.workspace import overview_plot, workspace_plot
from ccnn_torch.report.results.run import RunResults

_LINKED = ("results.json", "results.csv", "card.json", "model.safetensors", "model.onnx", "config.yaml")


def write_report(folder: str | Path, results: RunResults | None = None) -> Path:
    """Write `results.csv`, `results.md`, `plots/` and `report.html` of a run folder.

    Reads, as far as they are there, `arrays.safetensors`, `history-METHOD.safetensors` and `config.yaml`; the same
    files give the same report, so it can be written again at any time.

    Args:
        results: the content of its `results.json`, which is read when None.

    Returns:
        The path of `report.html`.
    """
    folder = Path(folder)
    results = RunResults.read(folder / "results.json") if results is None else results
    write_tables(folder, results)
    figures = inline_figures(run_plots(folder, results), folder / "plots")
    return run_page(results, figures).write_html(folder / "report.html", _LINKED)


def run_plots(folder: str | Path, results: RunResults) -> list[Plot]:
    """All pictures of a run folder, in reading order; a picture whose data is not there is left out."""
    folder = Path(folder)
    plots: list[Plot | None] = []
    if (folder / ARRAYS_FILE).is_file():
        arrays = load_arrays(folder)
        plots += [pose_error_plot(arrays), workspace_plot(arrays), joint_error_plot(arrays)]
        if arrays.masks:
            names = [joint.name for joint in arrays.joints]
            method = arrays.labels.get("method", "model")
            plots.append(network_plot(arrays.masks, arrays.weights, method, names))
    levels = {"floor": results.floor and results.floor.realised, "constant": results.constant.test}
    lines = {name: block["all"].mse.median for name, block in levels.items() if block and "all" in block}
    paths = {method: folder / f"history-{method}.safetensors" for method in results.methods}
    histories = {method: load_history(path) for method, path in paths.items() if path.is_file()}
    unit = results.joints[0].unit
    plots.append(progress_plot(histories, unit=unit, **lines))
    for method, history in histories.items():
        plots.append(convergence_plot(history, method, unit=unit, **lines))
        plots.append(population_plot(history, method))
    return [plot for plot in plots if plot is not None]


def make_picture(folder: str | Path, path: str | Path, joint: str | None = None) -> str:
    """Draw the one wide picture of a run: joint error and workspace, before and after.

    Args:
        path: where to write; `.png` and `.svg` are both written.
        joint: name of the joint shown; by default the one with the largest error.

    Returns:
        The caption.
    """
    arrays = load_arrays(folder)
    names = [j.name for j in arrays.joints]
    if joint is not None and joint not in names:
        raise InputError(f"There is no joint {joint!r}; this run has {', '.join(names)}.")
    plot = overview_plot(arrays, None if joint is None else names.index(joint))
    save_figure(plot.figure, path)
    return plot.caption
