"""The picture of the machine with its errors as arrows or circles, before and after on one scale."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from diagnosis_cases import one_effect, with_rotation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.quiver import Quiver

from ccnn_torch.report.figures import save_figure
from ccnn_torch.report.machine import machine_plot


def _arrays() -> dict[str, np.ndarray]:
    arrays = {name: value.numpy() for name, value in one_effect()[1].items()}
    arrays["drawn.line.leg 1"] = np.array([[-0.2, 0.0, 0.0], [-0.3, 0.2, 0.0], [0.0, 0.3, 0.0]])
    arrays["drawn.line.leg 2"] = arrays["drawn.line.leg 1"] * [-1, 1, 1]
    return arrays


def _arrows(figure: Figure) -> list[Quiver]:
    return [artist for axes in figure.axes for artist in axes.collections if isinstance(artist, Quiver)]


def test_arrows_are_the_residuals_before_and_after_on_the_scale_that_is_stated() -> None:
    arrays = _arrays()
    plot = machine_plot(arrays, "With compliance in it")
    assert plot is not None
    machine, before, after = plot.figure.axes
    stated = re.search(r"(\d+) times as large on both sides", plot.caption)
    assert stated is not None and f"(arrows {stated[1]} ×)" in before.artists[0].text.get_text()
    rows = np.flatnonzero(arrays["set_aside"] < 0.5)
    for arrows, name in zip(_arrows(plot.figure), ("drawn.before", "drawn.after"), strict=True):
        which = [int(np.argmin(np.abs(1e3 * arrays["drawn.place"][rows, 0] - x))) for x in arrows.XY[:, 0]]
        assert len(which) == 160 and np.allclose(
            np.stack([arrows.U, arrows.V], -1), 1e3 * float(stated[1]) * arrays[name][rows[which]][:, :2]
        )
    assert before.get_xlim() == after.get_xlim() and before.get_ylim() == after.get_ylim()
    assert [axes.get_xlabel() for axes in plot.figure.axes] == ["x [mm]"] * 3 and before.get_ylabel() == "y [mm]"
    assert len(machine.lines) == 2 and [text.get_text() for text in machine.texts] == ["1", "2"]
    assert "With compliance in it" in after.get_title(loc="left")


def test_the_plane_is_that_of_the_largest_extent() -> None:
    arrays = {name: value.numpy() for name, value in one_effect()[1].items()}
    arrays["drawn.place"] = arrays["drawn.place"][:, [0, 2, 1]]
    plot = machine_plot(arrays, "What is left")
    assert plot is not None and len(plot.figure.axes) == 2
    assert plot.figure.axes[0].get_ylabel() == "z [mm]"
    assert "What is left" in plot.figure.axes[1].get_title(loc="left")


def test_a_long_title_stays_within_the_picture() -> None:
    plot = machine_plot(_arrays(), "With geometry + effects + constant")
    assert plot is not None
    FigureCanvasAgg(plot.figure).draw()
    title = plot.figure.axes[-1]._left_title.get_window_extent()  # type: ignore[attr-defined]
    assert title.x1 < plot.figure.bbox.x1


def test_titles_and_axes_of_a_saved_picture_are_within_it(tmp_path: Path) -> None:
    arrays = {name: value.numpy() for name, value in one_effect()[1].items()}
    # Low places in a picture of two panels.
    arrays["drawn.place"] = np.array([2.3, 1.1, -0.3]) + np.array([0.55, 0.45, 0.1]) * _unit(arrays["drawn.place"])
    plot = machine_plot(arrays, "With thermal growth in it")
    assert plot is not None
    save_figure(plot.figure, tmp_path / "machine", pixels=False)
    FigureCanvasAgg(plot.figure).draw()
    for axes in plot.figure.axes:
        title = axes._left_title.get_window_extent()  # type: ignore[attr-defined]
        below = axes.xaxis.label.get_window_extent()
        assert title.y1 < plot.figure.bbox.y1 and below.y0 > plot.figure.bbox.y0


def _unit(place: np.ndarray) -> np.ndarray:
    """Places within half a unit of nought."""
    low, high = np.nanmin(place, 0), np.nanmax(place, 0)
    return np.asarray((place - low) / np.maximum(high - low, 1e-12) - 0.5)


def test_errors_without_a_direction_are_circles_as_wide_as_they_are_large() -> None:
    arrays = _arrays()
    for name in ("drawn.before", "drawn.after"):
        arrays[name] = np.linalg.norm(arrays[name], axis=1)
    plot = machine_plot(arrays, "As identified")
    assert plot is not None and not _arrows(plot.figure)
    stated = re.search(r"circles as wide as the error is large, (\d+) times", plot.caption)
    circles = [artist for artist in plot.figure.axes[1].patches if isinstance(artist, Circle)]
    assert stated is not None and len(circles) == 160
    place = [int(np.nanargmin(np.abs(1e3 * arrays["drawn.place"][:, 0] - c.center[0]))) for c in circles]
    sizes = 1e3 * float(stated[1]) * arrays["drawn.before"][place]
    assert np.allclose([2 * c.radius for c in circles], sizes)


@pytest.mark.parametrize("change", ["still", "line", "missing"])
def test_what_spans_no_plane_has_no_picture(change: str) -> None:
    arrays = {name: value.numpy() for name, value in with_rotation()[1].items()}
    if change == "still":
        arrays["drawn.before"][:] = 0
    elif change == "line":
        arrays["drawn.place"][:, 1:] = 0
    else:
        del arrays["drawn.place"]
    assert machine_plot(arrays, "after") is None
