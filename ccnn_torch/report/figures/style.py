"""One look for all pictures, and files that are the same bytes for the same numbers.

Figures are made without pyplot, so nothing of matplotlib's global state is read or left behind.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from ccnn_torch.files.write import write_whole
from ccnn_torch.report.page import InlineFigure

# Okabe and Ito's palette: distinguishable with every common form of colour blindness, and in grey print.
BEFORE = "#D55E00"
AFTER = "#0072B2"
FLOOR = "#6E6E6E"
GREY = "#B8B8B8"
SERIES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
RASTER_ABOVE = 3000
"""Points above which a layer is drawn as pixels inside the SVG, which would else grow to megabytes."""

_PNG_DPI = 150
_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.8,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.facecolor": "white",
    "figure.dpi": 100,
    "lines.linewidth": 1.6,
    "axes.formatter.useoffset": False,
    "svg.hashsalt": "ccnn_torch",
    "svg.fonttype": "path",
}

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Plot:
    """A picture: its file name without ending, the figure, and its caption."""

    name: str
    figure: Figure
    caption: str


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """Run a function with the plot style of this package."""

    @wraps(function)
    def inner(*args: P.args, **kwargs: P.kwargs) -> T:
        with mpl.rc_context(_STYLE):
            return function(*args, **kwargs)

    return inner


@styled
def save_figure(figure: Figure, path: str | Path) -> list[Path]:
    """Write a figure as PNG and as SVG; equal figures give equal bytes.

    Args:
        figure: what to write.
        path: file name; its ending, if any, is replaced by `.png` and `.svg`.

    Returns:
        The two paths.

    Raises:
        WriteError: they cannot be written.
    """
    png, svg = Path(path).with_suffix(".png"), Path(path).with_suffix(".svg")
    # The layout is found once and kept: finding it again for each file costs more than the drawing. The canvas that
    # measures the texts for it draws the PNG, too, and need not measure them again.
    figure.set_dpi(_PNG_DPI)
    canvas = FigureCanvasAgg(figure)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    # Written by the canvases themselves: `savefig` draws everything once more beforehand, to find the layout.
    for path, print_to, about in (
        (png, canvas.print_png, {"Software": None}),
        (svg, FigureCanvasSVG(figure).print_svg, {"Date": None, "Creator": None}),
    ):
        content = io.BytesIO()
        print_to(content, metadata=about)
        write_whole(path, content.getvalue())
    return [png, svg]


def inline_figures(plots: Iterable[Plot], folder: Path) -> list[InlineFigure]:
    """Save plots as `save_figure` does, and give them as figures of a page."""
    found = []
    for plot in plots:
        _, svg = save_figure(plot.figure, folder / plot.name)
        text = inline_svg(svg.read_text(encoding="utf-8"), plot.name)
        found.append(InlineFigure(plot.name, plot.caption, text))
    return found


def inline_svg(text: str, name: str) -> str:
    """A saved SVG as an element for a page that holds several: no prolog, no metadata, ids that begin with the name.

    Args:
        text: content of an SVG file that `save_figure` wrote.
        name: the plot's name.
    """
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\1{name}-", text)


def bare(axes: Axes) -> None:
    """Take the grid and all spines away, for pictures of matrices and maps."""
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
