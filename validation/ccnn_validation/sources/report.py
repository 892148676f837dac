"""Figures of the independent sources: right answers by source and family, with 95 % intervals, the worst first."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ccnn_torch.report.csv_file import write_rows
from ccnn_validation.blind.report import share

__all__ = ["figures", "write_sources"]

Case = Mapping[str, Any]
_CONFIDENT = 0.95
_KINDS = ("none", "single", "pair", "several", "outside", "data")


def figures(cases: Sequence[Case]) -> dict[str, dict[str, Any]]:
    """Name of a figure -> `{"count", "of", "share", "low", "high"}` of the cases of one source."""
    claims = [c for c in cases if c["probability"] >= _CONFIDENT]
    kinds = {f"{kind}, right": _rate(c for c in cases if c["kind"] == kind) for kind in _KINDS}
    quiet = [c for c in cases if c["kind"] == "none"]
    return {
        **kinds,
        "pair, both found": share(c["found"] for c in cases if c["kind"] in ("pair", "several")),
        "none, false alarms, white noise": _alarms(quiet, lambda k: k == "white"),
        "none, false alarms, other noise": _alarms(quiet, lambda k: k != "white"),
        "claims of 0.95 and more, right": _rate(claims),
        "wrong name above 0.9": share(c["wrong_name"] for c in cases),
        "intervals of the shrink that hold": share(c["shrink"]["holds"] for c in cases if c.get("shrink")),
    }


def write_sources(folder: Path, sources: Mapping[str, Sequence[Case]]) -> Path:
    """Write `sources.csv`: figures by source and, below them, by family, the worst first; returns its path."""
    rows: list[tuple[Any, ...]] = []
    for source, cases in sources.items():
        for name, block in figures(cases).items():
            if block["of"]:
                rows.append((source, "all", name, *_numbers(block)))
    for source, cases in sources.items():
        families = {c["family"]: _rate(d for d in cases if d["family"] == c["family"]) for c in cases}
        for family, block in sorted(families.items(), key=lambda item: (item[1]["share"], item[0])):
            rows.append((source, family, "right", *_numbers(block)))
    path = folder / "sources.csv"
    write_rows(path, ("source", "family", "figure", "count", "cases", "share", "low", "high"), rows)
    return path


def _rate(cases: Iterable[Case]) -> dict[str, Any]:
    return share(c["right"] for c in cases)


def _alarms(cases: Sequence[Case], kind: Callable[[str], bool]) -> dict[str, Any]:
    return share(not c["right"] for c in cases if kind(c["noise_kind"]))


def _numbers(block: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(block[key] for key in ("count", "of", "share", "low", "high"))
