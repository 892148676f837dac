"""The table as Markdown and JSON, and one figure."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.field.data import Source
from benchmarks.field.scores import INJECTION, REPLICATES
from benchmarks.field.splits import HELD_OUT, SEED, TRAINING

Found = tuple[str, str, str, dict[str, Any]]
"""Set, task, entry, scores."""


def write_results(
    out: Path, cells: Sequence[Found], sets: Mapping[str, Source], about: Mapping[str, str], notes: Sequence[str]
) -> None:
    """Write table.json, table.md and errors.png."""
    sources = {name: {"sha256": s.sha256, "origin": s.origin, "licence": s.licence} for name, s in sets.items()}
    rows = [{"set": s, "task": t, "entry": e, **found} for s, t, e, found in cells]
    content = {"seed": SEED, "training_rows": TRAINING, "sources": sources, "cells": rows, "notes": list(notes)}
    (out / "table.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (out / "table.md").write_text(markdown(cells, sets, about, notes), encoding="utf-8")
    draw([cell for cell in cells if cell[1] not in (REPLICATES, INJECTION)]).savefig(out / "errors.png", dpi=110)


def markdown(cells: Sequence[Found], sets: Mapping[str, Source], about: Mapping[str, str], notes: Sequence[str]) -> str:
    """Held-out errors by split, then what else is scored, then the sources."""
    entries = list(dict.fromkeys(cell[2] for cell in cells))
    by_task: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for name, task, entry, found in cells:
        by_task.setdefault((name, task), {})[entry] = found
    tables = [
        ("RMS error of held-out positions [µm], of orientations [µrad] after the slash", _error),
        ("Held-out RMS of positions over the noise of a reading", _ratio),
        ("Coverage of the entry's 95 % intervals [%]", _coverage),
        ("RMS difference of two fits to two halves of the training rows [µm]", _replicate),
        ("A known change in half of the rows: what is named, and the share of its size that is found", _causes),
    ]
    lines = [
        f"At most {TRAINING} training rows, {100 * HELD_OUT:.0f} % held out, seed {SEED}. Of the telescope a µm is a "
        "µrad. The lowest error of a row is bold. Of sockets and of another day a rigid motion of the measuring frame "
        "is fitted to the held-out rows, of all entries alike."
    ]
    for title, show in tables:
        shown = {key: {e: show(key[1], f) for e, f in found.items()} for key, found in by_task.items()}
        shown = {key: row for key, row in shown.items() if any(row.values())}
        if shown:
            lines += ["", title + ":", "", *_table(shown, entries, by_task if show is _error else {})]
    lines += ["", *(f"* `{name}`: {about[name]}" for name in entries)]
    lines += [f"* {name}: {s.origin}, {s.licence}" for name, s in sets.items()]
    lines += [f"* {note}" for note in notes]
    failed = [f"* {s}, {t}, `{e}` failed: {found['failed']}" for s, t, e, found in cells if "failed" in found]
    return "\n".join([*lines, *failed]) + "\n"


def _table(
    shown: Mapping[tuple[str, str], Mapping[str, str]],
    entries: Sequence[str],
    judged: Mapping[tuple[str, str], Mapping[str, dict[str, Any]]],
) -> list[str]:
    used = [e for e in entries if any(row.get(e) for row in shown.values())]
    lines = ["| set | rows | " + " | ".join(f"`{e}`" for e in used) + " |", "| --- | --- |" + " ---: |" * len(used)]
    for key, row in shown.items():
        # As printed, so that equal ones are alike.
        places = {e: round(1e6 * f["position"]) for e, f in judged.get(key, {}).items() if "position" in f}
        best = min(places.values()) if len(places) > 1 else None
        texts = [f"**{row[e]}**" if e in places and places[e] == best else row.get(e, "") or "–" for e in used]
        lines.append(f"| {key[0]} | {key[1]} | " + " | ".join(texts) + " |")
    return lines


def _error(task: str, found: Mapping[str, Any]) -> str:
    if task in (REPLICATES, INJECTION) or "position" not in found:
        return "failed" if "failed" in found and task not in (REPLICATES, INJECTION) else ""
    turned = f" / {1e6 * found['rotation']:.0f}" if "rotation" in found else ""
    return f"{1e6 * found['position']:.0f}{turned}"


def _ratio(task: str, found: Mapping[str, Any]) -> str:
    return f"{found['over_floor']:.1f}" if "over_floor" in found else ""


def _coverage(task: str, found: Mapping[str, Any]) -> str:
    return f"{100 * found['coverage']:.0f}" if "coverage" in found else ""


def _replicate(task: str, found: Mapping[str, Any]) -> str:
    return f"{1e6 * found['position']:.0f}" if task == REPLICATES and "position" in found else ""


def _causes(task: str, found: Mapping[str, Any]) -> str:
    texts = []
    for cause, said in found.get("causes", {}).items():
        named = "named" if said["right"] else f"named {said['named']}"
        texts.append(f"{cause}: {named}, {100 * said['share']:.0f} %")
    return "; ".join(texts)


def draw(cells: Sequence[Found]) -> Figure:
    """Held-out error as a share of that of the nominal machine, one line for each split of a set."""
    keys = list(dict.fromkeys((s, t) for s, t, _, _ in cells))
    entries = list(dict.fromkeys(e for _, _, e, _ in cells))
    found = {(s, t, e): f["position"] for s, t, e, f in cells if "position" in f}
    figure = Figure(figsize=(8.0, 1.4 + 0.28 * len(keys)), layout="constrained")
    axes = figure.subplots()
    for k, entry in enumerate(entries):
        points = [
            (found[*key, entry] / found.get((*key, "nominal"), 1.0), line)
            for line, key in enumerate(keys)
            if (*key, entry) in found
        ]
        if points:
            axes.plot(*zip(*points, strict=True), "osD^vPX*"[k % 8], label=entry)
    axes.set_yticks(range(len(keys)), [f"{s}, {t}" for s, t in keys])
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="held-out position error, share of the nominal machine's (frames fitted)")
    axes.grid(axis="x", which="both", alpha=0.3)
    if entries:
        figure.legend(loc="outside lower center", ncols=3)
    return figure
