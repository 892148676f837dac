"""Maps of the pose error of an identified machine over its workspace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.figures.style import SERIES, Plot, styled

Arrays = Mapping[str, NDArray[np.float64]]
Results = Mapping[str, Any]


@styled
def map_plot(results: Results, arrays: Arrays) -> Plot | None:
    """RMS position error over the machines at each place, before and by each method (Figure 6 of paper 004)."""
    if "map" not in arrays or "map_before" not in arrays:
        return None
    maps = {"before": arrays["map_before"]}
    maps |= {m: arrays[f"map_{m}"] for m in results["methods"] if f"map_{m}" in arrays}
    known = np.isfinite(np.stack(list(maps.values()))).all(0)
    place = arrays["map"][known, :2]
    maps = {name: values[known] for name, values in maps.items()}
    after = np.concatenate([v for name, v in maps.items() if name != "before"])
    scale, unit = display_unit("m", float(np.median(after)))
    norm = LogNorm(float(np.quantile(after, 0.01)) / scale, float(np.quantile(after, 0.99)) / scale, clip=True)
    first_scale, first_unit = display_unit("m", float(np.median(maps["before"])))
    figure = Figure(figsize=(3.3 * len(maps) + 1.2, 3.5), layout="constrained")
    texts = []
    drawn: Any = None
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, (name, values) in zip(panels, maps.items(), strict=True):
        own = name == "before"
        shown = values / (first_scale if own else scale)
        # Before, the error is hundreds of times larger: it has a scale of its own.
        picture = axes.scatter(*place.T, c=shown, s=14, marker="s", cmap="viridis", norm=None if own else norm)
        # The median: at the edge, which is singular, one place counts more than all others in a mean square.
        middle = number_text(float(np.median(values)) / (first_scale if own else scale), 3)
        texts.append(f"{name} {middle} {first_unit if own else unit}")
        axes.set_title(f"{name}: median {middle} {first_unit if own else unit}")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.grid(False)
        if own:
            figure.colorbar(picture, ax=axes, shrink=0.8, label=first_unit)
        else:
            drawn = picture
    if drawn is not None:
        figure.colorbar(drawn, ax=list(panels[1:]), shrink=0.8, label=unit)
    return Plot(
        "map",
        figure,
        "Position error over the workspace, commanded exactly by the geometry: RMS over the machines at each place, "
        "and of these the median over the places: " + ", ".join(texts) + ".",
    )


@styled
def poses_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Where the first machine was measured: common poses and those of each leg (Figure 4 of paper 004)."""
    if "observed" not in arrays:
        return None
    sets = {"common": arrays["observed"][0]}
    sets |= {f"leg {name[len('observed_leg') :]}": arrays[name][0] for name in sorted(arrays) if "observed_leg" in name}
    if sets["common"].shape[1] < 2:
        return None
    figure = Figure(figsize=(3.4 * len(sets) + 0.4, 3.4), layout="constrained")
    for k, (axes, (name, pose)) in enumerate(
        zip(figure.subplots(1, len(sets), squeeze=False)[0], sets.items(), strict=True)
    ):
        if "map" in arrays:
            axes.plot(*arrays["map"][:, :2].T, ".", color="#DDDDDD", markersize=2)
        axes.plot(pose[:, 0], pose[:, 1], "o", color=SERIES[k % len(SERIES)], markersize=5)
        axes.set_title(f"{name}: {len(pose)} poses")
        axes.set_aspect("equal", adjustable="datalim")
    return Plot("poses", figure, "First two measured coordinates of the poses that were identified from.")
