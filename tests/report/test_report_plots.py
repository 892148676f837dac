"""Every picture shows the numbers it was given, says its units, and is the same file for the same numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import LogNorm
from report_runs import arm_run

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.figures import (
    Plot,
    inline_svg,
    joint_error_plot,
    pose_error_plot,
    save_figure,
    workspace_plot,
)
from ccnn_torch.report.results.base import Spread, interval_text

SVG = "{http://www.w3.org/2000/svg}"


def dots(plot: Plot, panel: int, label: str) -> np.ndarray:
    """The y values of a labelled line of a panel."""
    (line,) = [line for line in plot.figure.axes[panel].lines if line.get_label() == label]
    return np.asarray(line.get_ydata())


def all_plots(arrays: RunArrays) -> list[Plot | None]:
    return [
        joint_error_plot(arrays),
        pose_error_plot(arrays),
        workspace_plot(arrays),
    ]


def test_every_axis_has_a_label_with_a_unit(arrays: RunArrays) -> None:
    for plot in all_plots(arrays):
        assert plot is not None and plot.caption.endswith(".")
        for axes in plot.figure.axes:
            assert axes.has_data()
            assert axes.get_ylabel()
        labelled = " ".join(axes.get_ylabel() + axes.get_xlabel() for axes in plot.figure.axes)
        assert "[" in labelled and "]" in labelled


def test_joint_errors_are_the_held_out_numbers(arrays: RunArrays) -> None:
    plot = joint_error_plot(arrays)
    test = arrays.test
    for i in range(3):
        assert dots(plot, i, "before") == pytest.approx(arrays.measured[test, i] * 1e6)
        assert dots(plot, i, "after") == pytest.approx((arrays.measured - arrays.predicted)[test, i] * 1e6)
        assert plot.figure.axes[i].get_ylabel() == f"error of q{i + 1} [µm]"


def test_many_rows_leave_the_training_rows_out() -> None:
    _, arrays = arm_run(rows=250)
    plot = joint_error_plot(arrays)
    drawn = sum(len(line.get_xdata()) for line in plot.figure.axes[0].lines if line.get_label() in ("before", "after"))
    assert drawn == 2 * arrays.test.sum()
    assert "faint" not in plot.caption


def test_pose_error_is_the_empirical_distribution(arrays: RunArrays) -> None:
    plot = pose_error_plot(arrays)
    assert [axes.get_xlabel() for axes in plot.figure.axes] == ["position error [µm]", "rotation error [µrad]"]
    (line,) = [line for line in plot.figure.axes[0].lines if line.get_label() == "after"]
    x, share = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    errors = arrays.position_after[arrays.test] * 1e6
    for at in np.quantile(errors, [0.1, 0.5, 0.9]) + 1e-9:
        drawn = share[np.searchsorted(x, at, side="right") - 1]
        assert drawn == pytest.approx(100 * np.mean(errors <= at))
    assert number_text(float(np.median(errors)), 3) in plot.caption
    alone = pose_error_plot(replace(arrays, rotation_before=None, rotation_after=None))
    assert len(alone.figure.axes) == 1


def test_before_and_after_share_one_colour_scale(arrays: RunArrays) -> None:
    plot = workspace_plot(arrays)
    assert plot is not None
    meshes = [m for axes in plot.figure.axes[:2] for m in axes.collections if isinstance(m, QuadMesh)]
    assert len(meshes) == 2 and meshes[0].norm is meshes[1].norm and isinstance(meshes[0].norm, LogNorm)
    assert arrays.map_before is not None
    assert np.sort(np.ma.getdata(meshes[0].get_array()).ravel()) == pytest.approx(np.sort(arrays.map_before) * 1e6)
    assert plot.figure.axes[0].get_xlabel() == "y [mm]"


def test_several_poses_of_a_place_are_averaged_by_their_square(arrays: RunArrays) -> None:
    plot = workspace_plot(replace(arrays, map_place=None, test=np.ones(125, dtype=bool)))
    assert plot is not None
    (mesh,) = [m for m in plot.figure.axes[0].collections if isinstance(m, QuadMesh)]
    corner = (arrays.place[:, 1] == -0.2) & (arrays.place[:, 2] == 0.4)
    assert corner.sum() == 5
    together = np.sqrt(np.mean(np.square(arrays.position_before[corner])))
    assert np.ma.getdata(mesh.get_array()).ravel()[0] == pytest.approx(together * 1e6)


def test_an_arm_is_seen_from_above_and_from_the_side() -> None:
    _, arrays = arm_run()
    plot = workspace_plot(arrays)
    assert plot is not None
    panels = plot.figure.axes[:4]
    assert [(a.get_xlabel(), a.get_ylabel()) for a in panels[::2]] == [("x [mm]", "y [mm]"), ("x [mm]", "z [mm]")]
    (cloud,) = [c for c in panels[0].collections if isinstance(c, PathCollection)]
    assert len(cloud.get_offsets()) == arrays.test.sum()


def test_a_machine_that_turns_is_seen_over_its_angles(arrays: RunArrays) -> None:
    axes = (Coordinate("theta_x", "rad"), Coordinate("theta_y", "rad"), Coordinate("z", "m"))
    plot = workspace_plot(replace(arrays, place=arrays.commanded, axes=axes, map_place=None))
    assert plot is not None
    assert plot.figure.axes[0].get_xlabel() == "theta_x [mrad]"
    assert plot.figure.axes[2].get_ylabel() == "z [mm]"


def test_a_machine_on_a_line_has_no_map(arrays: RunArrays) -> None:
    line = replace(arrays, place=arrays.place * np.array([0, 0, 1]), map_place=None)
    assert workspace_plot(line) is None


def test_thousands_of_dots_become_pixels(tmp_path: Path) -> None:
    _, arrays = arm_run(rows=12_000)
    path = save_figure(joint_error_plot(arrays).figure, tmp_path / "many", pixels=False)
    assert path.stat().st_size < 1_000_000
    assert "image/png;base64" in path.read_text()


def test_equal_numbers_give_equal_files(arrays: RunArrays, tmp_path: Path) -> None:
    save_figure(pose_error_plot(arrays).figure, tmp_path / "a.png")
    save_figure(pose_error_plot(arrays).figure, tmp_path / "b")
    assert {p.name for p in tmp_path.iterdir()} == {"a.png", "a.svg", "b.png", "b.svg"}
    for ending in ("png", "svg"):
        assert (tmp_path / f"a.{ending}").read_bytes() == (tmp_path / f"b.{ending}").read_bytes()


def test_inline_svg_stands_alone(arrays: RunArrays, tmp_path: Path) -> None:
    svg = save_figure(pose_error_plot(arrays).figure, tmp_path / "a", pixels=False)
    text = inline_svg(svg.read_text(), "pose_error")
    root = ElementTree.fromstring(text)
    assert root.tag == f"{SVG}svg"
    ids = [e.get("id") for e in root.iter() if e.get("id")]
    assert len(ids) == len(set(ids)) and all(str(i).startswith("pose_error-") for i in ids)
    used = {v[1:] for e in root.iter() for k, v in e.items() if k.endswith("href") and v.startswith("#")}
    assert used and used <= set(ids)


def test_the_house_style_leaves_matplotlib_alone(arrays: RunArrays) -> None:
    before = dict(mpl.rcParams)
    joint_error_plot(arrays)
    assert dict(mpl.rcParams) == before


@pytest.mark.parametrize(
    ("unit", "magnitude", "expected"),
    [
        ("m", 2.5e-4, (1e-6, "µm")),
        ("rad", 2e-3, (1e-3, "mrad")),
        ("m", 3e-8, (1e-9, "nm")),
        ("m", 0.0, (1e-9, "nm")),
        ("m", 20.0, (1.0, "m")),
        ("K", 1e-5, (1.0, "K")),
    ],
)
def test_display_units(unit: str, magnitude: float, expected: tuple[float, str]) -> None:
    assert display_unit(unit, magnitude) == expected


def test_number_and_interval_texts() -> None:
    assert [number_text(v) for v in (None, 0.0, 1.0, 259.24, 1.2e-10, 123456.0)] == [
        "–",
        "0",
        "1.000",
        "259.2",
        "1.200e-10",
        "1.235e+05",
    ]
    block = Spread(median=2e-6, low=1e-6, high=3e-6, values=[1e-6, None, 3e-6])
    assert interval_text(block, 1e-6) == "2.000 [1.00, 3.00] (2 of 3)"
    assert interval_text(None) == "–"
