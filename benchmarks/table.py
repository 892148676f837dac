"""The benchmarks' table as JSON and Markdown, and its growth curves as a picture."""

from __future__ import annotations

import datetime
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.measure import Row
from benchmarks.peers import missing

__all__ = ["growth", "write_results"]

# How far curves are drawn on, by what is counted.
FAR = {"rows": 1_000_000, "machines": 1000, "networks": 1_000_000}
# Sizes that tell how a task grows.
_FEWEST = 3


def write_results(folder: Path, found: dict[str, list[Row]], quick: bool) -> None:
    """Write table.json, table.md and growth.png."""
    folder.mkdir(parents=True, exist_ok=True)
    about = {
        "date": datetime.date.today().isoformat(),
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "quick": quick,
        "not_installed": missing(),
    }
    rows = {name: [asdict(row) for row in part] for name, part in found.items()}
    curves = growth([row for part in found.values() for row in part])
    content = {"about": about, "rows": rows, "growth": curves}
    (folder / "table.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / "table.md").write_text(markdown(about, found, curves), encoding="utf-8")
    draw([row for part in found.values() for row in part], curves).savefig(folder / "growth.png", dpi=120)


def processor() -> str:
    """The processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def growth(rows: list[Row]) -> list[dict[str, object]]:
    """Of each task with several sizes: the exponent between the two largest, and seconds at the size in `FAR`."""
    curves = []
    for (task, of), points in _by_task(rows).items():
        if len(points) < _FEWEST or of not in FAR:
            continue
        (n1, t1), (n2, t2) = sorted(points.items())[-2:]
        power = float(np.log(t2 / t1) / np.log(n2 / n1))
        far = max(FAR[of], n2)
        curves.append({"task": task, "of": of, "exponent": power, "size": far, "seconds": t2 * (far / n2) ** power})
    return curves


def _by_task(rows: list[Row]) -> dict[tuple[str, str], dict[int, float]]:
    points: dict[tuple[str, str], dict[int, float]] = {}
    for row in rows:
        points.setdefault((row.task, row.of), {})[row.size] = row.seconds
    return points


def markdown(about: Mapping[str, object], found: dict[str, list[Row]], curves: list[dict[str, object]]) -> str:
    """Machine, one table, and what the curves say far out."""
    absent = missing()
    lines = [
        f"{about['processor']}, {about['cores']} cores ({about['threads']} used), torch {about['torch']}, "
        f"{about['date']}{', `--quick`' if about['quick'] else ''}.",
        *([f"Left out, for they are not installed: {', '.join(absent)}."] if absent else []),
        "",
        "| benchmark | task | size | time | peer | peer / ours | share of gemm | |",
        "| --- | --- | ---: | ---: | --- | ---: | ---: | --- |",
    ]
    for name, rows in found.items():
        for row in rows:
            ratio = "" if row.ratio is None else f"{row.ratio:.3g}"
            limit = "" if row.limit is None else f"{100 * row.limit:.0f} %"
            cells = (name, row.task, f"{row.size:,} {row.of}", _time(row.seconds), row.peer, ratio, limit, row.note)
            lines.append("| " + " | ".join(cells) + " |")
    if curves:
        lines += ["", "| task | grows with the power | extrapolated to | time |", "| --- | ---: | ---: | ---: |"]
        for c in curves:
            shown = (c["task"], f"{c['exponent']:.2f}", f"{c['size']:,} {c['of']}", _time(float(str(c["seconds"]))))
            lines.append("| " + " | ".join(map(str, shown)) + " |")
    return "\n".join(lines) + "\n"


def _time(seconds: float) -> str:
    if seconds >= 7200:
        return f"{seconds / 3600:.3g} h"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def draw(rows: list[Row], curves: list[dict[str, object]]) -> Figure:
    """Seconds over size, one panel for what is counted; dashed where the last two sizes are drawn on."""
    kinds = sorted({str(c["of"]) for c in curves}) or ["rows"]
    figure = Figure(figsize=(5.0 * len(kinds), 6.0), layout="constrained")
    points = _by_task(rows)
    for axes, kind in zip(np.atleast_1d(figure.subplots(1, len(kinds))), kinds, strict=True):
        for k, c in enumerate(c for c in curves if c["of"] == kind):
            sizes, seconds = zip(*sorted(points[str(c["task"]), kind].items()), strict=True)
            # The cycle of colours begins again after ten.
            (line,) = axes.plot(sizes, seconds, "os^v"[k % 4] + "-", label=str(c["task"]))
            end = (c["size"], c["seconds"])
            axes.plot([sizes[-1], end[0]], [seconds[-1], end[1]], "--", color=line.get_color())
        axes.set(xscale="log", yscale="log", xlabel=kind, ylabel="processor time [s]")
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.15))
    return figure
