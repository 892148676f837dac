"""Figures of a verification: predicted against measured deviations, and the pose error of every row."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.figures import AFTER, BEFORE, RASTER_ABOVE, Plot, styled


@styled
def predicted_plot(arrays: RunArrays) -> Plot:
    """Predicted against measured deviation of each joint; on the line where the model is right."""
    count = len(arrays.joints)
    columns = min(count, 3)
    lines = -(-count // columns)
    figure = Figure(figsize=(2.9 * columns, 2.8 * lines + 0.2), layout="constrained")
    texts = []
    for i, axes in enumerate(figure.subplots(lines, columns, squeeze=False).flat):
        if i >= count:
            axes.set_visible(False)
            continue
        measured, predicted = arrays.measured[:, i], arrays.predicted[:, i]
        scale, unit = display_unit(arrays.joints[i].unit, float(np.abs(measured).max()))
        both = np.concatenate([measured, predicted]) / scale
        ends = [float(both.min()), float(both.max())]
        axes.plot(ends, ends, color="#555555", linewidth=0.8)
        raster = len(measured) > RASTER_ABOVE
        axes.plot(measured / scale, predicted / scale, "o", color=AFTER, markersize=3, rasterized=raster)
        axes.set_title(arrays.joints[i].name)
        axes.set_xlabel(f"measured [{unit}]")
        axes.set_ylabel(f"predicted [{unit}]")
        if np.ptp(measured) > 0 and np.ptp(predicted) > 0:
            texts.append(f"{arrays.joints[i].name} {number_text(float(np.corrcoef(measured, predicted)[0, 1]), 2)}")
    also = f" Correlation: {', '.join(texts)}." if texts else ""
    return Plot(
        "predicted",
        figure,
        f"Deviation of each joint as the model predicts it against that measured; on the line both agree.{also}",
    )


@styled
def pose_rows_plot(arrays: RunArrays) -> Plot:
    """Position (and rotation) error of each row, before and after."""
    pairs = arrays.pose_errors
    figure = Figure(figsize=(8.2, 2.2 * len(pairs) + 0.5), layout="constrained")
    row = np.arange(1, len(arrays.commanded) + 1)
    raster = len(row) > RASTER_ABOVE
    size = float(np.clip(40 / np.sqrt(len(row)), 1.5, 5))
    panels = figure.subplots(len(pairs), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (title, si_unit, before, after) in zip(panels, pairs, strict=True):
        scale, unit = display_unit(si_unit, float(np.nanmedian(before)))
        for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
            axes.plot(row, values / scale, "o", color=colour, markersize=size, label=label, rasterized=raster)
        axes.set_ylabel(f"{title} [{unit}]")
        axes.set_ylim(bottom=0)
    panels[-1].set_xlabel("row of the records")
    panels[0].legend(loc="upper right", ncols=2)
    return Plot("pose_rows", figure, "Pose error of each new row, before and after; a trend along the rows is drift.")
