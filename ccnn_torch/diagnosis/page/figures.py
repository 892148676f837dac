"""Pictures of a diagnosis: signatures of effects, the gap over the workspace, a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.page.data import About, Signature, used_rows
from ccnn_torch.display import display_unit, unit_text
from ccnn_torch.motion.stretches import PHASES
from ccnn_torch.report.figures import (
    AFTER,
    BEFORE,
    FLOOR,
    GREY,
    RASTER_ABOVE,
    SERIES,
    Plot,
    maps,
    planes_of,
    styled,
)

Array = NDArray[np.float64]
Arrays = Mapping[str, Array]
_KELVIN = 273.15
# A driver with no more values than this (a direction, a load put on or not) is drawn as columns of points.
_FEW = 6
# Share of the fit's variance between neighbours along the driver up to which a line shows it all.
_SMOOTH = 0.03


@styled
def signature_plot(signatures: Sequence[Signature], arrays: Arrays, effects: Sequence[str] = ()) -> Plot | None:
    """A panel for each signature.

    Args:
        signatures: in reading order.
        arrays: for which rows were held out and set aside.
        effects: names in the verdict; any other signature is that of a driver outside the library.
    """
    if not signatures:
        return None
    columns = min(2, len(signatures))
    lines = -(-len(signatures) // columns)
    figure = Figure(figsize=(4.7 * columns if columns > 1 else 6.4, 3.3 * lines + 0.35), layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    texts = []
    for axes, signature in zip(panels, signatures, strict=False):
        held, aside = used_rows(arrays, len(signature.x))
        name = signature.effect if signature.effect in effects else f"outside the library: {signature.effect}"
        axes.set_title(name)
        _draw(axes, signature, held, aside)
        judged = held & ~aside if (held & ~aside).sum() > 2 else ~aside
        share = _explained(signature.y[judged], signature.fit[judged])
        if share is not None:
            texts.append(f"{name} {100 * share:.3g} %")
    for axes in panels[len(signatures) :]:
        axes.set_axis_off()
    handles = {
        label: handle
        for axes in panels[: len(signatures)]
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=len(handles))
    caption = (
        "What gives each effect away: the residual along the effect's own direction, the other effects taken off, "
        "against what drives it."
    )
    if "set aside" in handles:
        caption += " Crosses: rows set aside, at the edge where they lie beyond it."
    if texts:
        caption += f" Share of the drawn variance on rows not used for fitting that the fit takes: {', '.join(texts)}."
    return Plot("signatures", figure, caption)


def axis_values(values: Array, axis: Coordinate) -> tuple[Array, str]:
    """Values for an axis and its label: lengths in mm, temperatures in °C."""
    if axis.unit == "K":
        return values - _KELVIN, f"{axis.name} [°C]"
    scale, unit = (1e-3, "mm") if axis.unit == "m" else (1.0, unit_text(axis.unit))
    return values / scale, f"{axis.name} [{unit}]"


def _draw(axes: Axes, signature: Signature, held: NDArray[np.bool_], aside: NDArray[np.bool_]) -> None:
    x, x_label = axis_values(signature.x, signature.x_axis)
    typical = float(np.nanquantile(np.abs(signature.y[~aside]), 0.9)) if (~aside).any() else 1.0
    scale, unit = display_unit(signature.y_axis.unit, typical or 1.0)
    y, fit = signature.y / scale, signature.fit / scale
    values = np.unique(x[np.isfinite(x)])
    few = len(values) <= _FEW
    step = float(np.diff(values).min()) if len(values) > 1 else 1.0
    # Spread in order of the rows, not at random: the same file gives the same picture.
    shift = 0.5 * step * ((np.arange(len(x)) * 0.6180339887498949) % 1 - 0.5) if few else np.zeros(len(x))
    raster = len(x) > RASTER_ABOVE
    size = float(np.clip(3000 / len(x), 4, 18))
    for rows, colour, label in ((~held & ~aside, GREY, "rows fitted on"), (held & ~aside, AFTER, "rows held out")):
        if rows.any():
            axes.scatter((x + shift)[rows], y[rows], s=size, color=colour, linewidths=0, label=label, rasterized=raster)
    # Of a row next to a singularity there is nothing to draw.
    shown = aside & (np.abs(y) + np.abs(fit) > 0)
    if shown.any():
        _draw_aside(axes, (x + shift)[shown], y[shown], y[~aside])
    _keep_to_most(axes, np.concatenate([y[~aside], fit[~aside]]))
    _draw_fit(axes, x[~aside], fit[~aside], values if few else None, step, size)
    axes.axhline(0, color=FLOOR, linewidth=0.8)
    axes.set(xlabel=x_label, ylabel=f"{signature.y_axis.name} [{unit}]")
    if few:
        axes.set_xticks(values)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _keep_to_most(axes: Axes, values: Array) -> None:
    """Cut the axis where a few rows next to a singularity would press all others onto one line."""
    low, high = (float(v) for v in np.nanquantile(values, (0.01, 0.99)))
    whole = (float(np.nanmin(values)), float(np.nanmax(values)))
    if whole[1] - whole[0] > 2.5 * (high - low) > 0:
        axes.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
        axes.annotate("a few rows lie beyond", (0.99, 0.02), xycoords="axes fraction", ha="right", fontsize=8)


def _draw_aside(axes: Axes, x: Array, y: Array, others: Array) -> None:
    """Rows set aside, drawn at the edge where they lie far beyond all others."""
    low, high = (float(v) for v in np.nanquantile(others, (0, 1)))
    margin = 0.15 * (high - low)
    axes.scatter(
        x, np.clip(y, low - margin, high + margin), s=26, marker="x", color="#222222", linewidths=1.1, label="set aside"
    )


def _draw_fit(axes: Axes, x: Array, fit: Array, values: Array | None, step: float, size: float) -> None:
    if values is not None:
        means = [float(fit[x == value].mean()) for value in values]
        axes.hlines(means, values - 0.32 * step, values + 0.32 * step, color=BEFORE, linewidth=2.2, label="fit")
        return
    order = np.argsort(x, kind="stable")
    ordered = fit[order]
    rough = float(np.square(np.diff(ordered)).mean()) / 2
    # A constant offset is a line as well, even if rounding leaves some variance.
    if rough <= _SMOOTH * float(ordered.var()) or rough < 1e-6 * float(np.square(ordered).mean()):
        axes.plot(x[order], ordered, color=BEFORE, linewidth=2, label="fit")
    else:
        axes.scatter(x, fit, s=size, color=BEFORE, linewidths=0, alpha=0.8, label="fit")


def _explained(y: Array, fit: Array) -> float | None:
    known = np.isfinite(y + fit)
    if known.sum() < 3 or not (variance := float(np.square(y[known]).mean())):
        return None
    return max(0.0, 1 - float(np.square((y - fit)[known]).mean()) / variance)


@styled
def remainder_map(arrays: Arrays, about: About) -> Plot | None:
    """The gap over the workspace as the model is, and what the verdict's effects leave.

    A machine whose position does not span a plane is drawn over its first joints.
    """
    if "residual" not in arrays or "remainder" not in arrays:
        return None
    held, aside = used_rows(arrays, len(arrays["residual"]))
    rows = held & ~aside if (held & ~aside).any() else ~aside
    before, after = (arrays[name][rows] for name in ("residual", "remainder"))
    quantity, unit, part = "position gap", "m", slice(0, 3)
    if not np.nanmax(np.abs(before[:, part]), initial=0.0) > 0 and before.shape[1] > 3:
        quantity, unit, part = "rotation gap", "rad", slice(3, None)
    before, after = (np.linalg.norm(values[:, part], axis=-1) for values in (before, after))
    found = _places(arrays, about)
    if found is None:
        return None
    place, axes, over = found
    place = place[rows]
    known = np.isfinite(before + after) & np.isfinite(place).all(-1)
    place, before, after = place[known], before[known], after[known]
    if not len(before) or not before.max() > 0:
        return None
    titles = "Model as it is", "What the verdict leaves"
    figure, text = maps(axes, place, before, after, titles=titles, quantity=quantity, si_unit=unit)
    which = "rows not used for fitting" if (held & ~aside).any() else "rows"
    caption = f"The {quantity} over the {over}, on {len(before)} {which}, on one scale: {text}. A pattern that is left "
    return Plot("map", figure, caption + "on the right is not explained; noise has none.")


def _places(arrays: Arrays, about: About) -> tuple[Array, tuple[Coordinate, ...], str] | None:
    """Coordinates to draw over, their names, and what they are."""
    place = tuple(Coordinate(name, "m") for name in "xyz")
    joints = tuple(Coordinate(f"q{i + 1}", about.unit(f"q{i + 1}")) for i in range(_width(arrays.get("joints"))))
    for name, axes, over in (("place", place, "workspace"), ("joints", joints, "joints")):
        if name in arrays and len(axes) > 1:
            values = arrays[name]
            if planes_of(values[np.isfinite(values).all(-1)], axes):
                return values, axes, over
    return None


def _width(values: Array | None) -> int:
    return 0 if values is None else int(values.shape[1])


# Joints that are drawn, those with the largest gap.
_MOST = 3
# Phases that are shaded.
_SHADED = {"reversal": SERIES[1], "standstill": GREY}


@styled
def course_plot(results: Mapping[str, Any], arrays: Arrays) -> Plot | None:
    """Of the run with the largest gap: command and position, and the residual with and without the verdict's effects.

    Args:
        results: as in `diagnosis.json`.
        arrays: `time`, `judged` `b x s`, `command`, `position`, `before`, `after`, `phase` `n x b x s`, and `run` `b`.
    """
    if "before" not in arrays:
        return None
    judged, before = arrays["judged"] > 0.5, arrays["before"]
    size = (np.square(before) * judged).sum((0, 2))
    runs = arrays["run"]
    worst = max(np.unique(runs), key=lambda r: float(size[runs == r].mean()))
    mine = np.flatnonzero(runs == worst)
    by_joint = (np.square(before) * judged)[:, mine].sum((1, 2))
    joints = sorted(np.argsort(-by_joint)[:_MOST].tolist())
    figure = Figure(figsize=(8.4, 3.4 * len(joints)), layout="tight")
    grid = figure.subplots(2 * len(joints), 1, sharex=True, squeeze=False)[:, 0]
    unit = results["gap"]["unit"]
    for k, i in enumerate(joints):
        top, low = grid[2 * k], grid[2 * k + 1]
        scale, shown = display_unit(unit, float(np.abs(before[i][:, :][judged]).max()) or 1.0)
        for b in mine:
            on, first = judged[b], b == mine[0]
            t = arrays["time"][b][on]
            for axes, name, unit_, look, label in (
                (top, "command", 1.0, {"color": FLOOR, "linestyle": "--"}, "command"),
                (top, "position", 1.0, {"color": SERIES[2]}, "position"),
                (low, "before", scale, {"color": BEFORE}, "model as it is"),
                (low, "after", scale, {"color": AFTER}, "with the effects"),
            ):
                axes.plot(t, arrays[name][i, b][on] / unit_, label=label if first else None, **look)
            for name, colour in _SHADED.items():
                there = arrays["phase"][i, b][on] == PHASES.index(name)
                shade: dict[str, Any] = {
                    "color": colour,
                    "alpha": 0.18,
                    "linewidth": 0,
                    "label": name if first else None,
                }
                low.fill_between(t, 0, 1, where=there, transform=low.get_xaxis_transform(), **shade)
        top.set_ylabel(f"q{i + 1} [{unit}]")
        low.set_ylabel(f"residual [{shown}]")
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=2)
        low.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=4)
    grid[-1].set_xlabel("time [s]")
    caption = (
        "The run with the largest gap. Measured less simulated position, held out: by a fit that saw no part of this "
        "run (or, of a single run, not this part). Shaded: reversals (yellow) and standstill (grey)."
    )
    return Plot("course", figure, caption)
