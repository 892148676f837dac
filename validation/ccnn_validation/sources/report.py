"""Figures of the independent sources: right answers by source and family, with 95 % intervals, the worst first."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ccnn_torch.files.write import write_rows, write_whole
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.table import Table, markdown_table
from ccnn_validation.blind.report import share

__all__ = ["figures", "source_tables", "write_source"]

Case = Mapping[str, Any]
Block = dict[str, Any]
_CONFIDENT = 0.95
_KEYS = ("count", "of", "share", "low", "high")
_NOTES = {
    "semi_real": "A known error is added to measured rows of real arms; right: the verdict gains its name alone.",
    "multibody": "Machines are simulated in MuJoCo; a cause is a change of its model.",
    "motion": "Axes in motion, simulated in MuJoCo; a cause changes its model or what its controller is told.",
    "adversarial": "Noise, designs and causes that are not of the textbook's form.",
    "shop": "Machines of a workshop, by somebody who had read the documentation only.",
}
_KINDS = ("none", "single", "pair", "several", "outside", "data")


def figures(cases: Sequence[Case]) -> dict[str, Block]:
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


def source_tables(source: str, cases: Sequence[Case]) -> list[Table]:
    """Figures of a source, and right answers by family, the worst first."""
    found = {name: block for name, block in figures(cases).items() if block["of"]}
    note = "Brackets: 95 % intervals (Clopper and Pearson). " + _NOTES.get(source, "")
    return [
        Table(f"Source {source}", ("figure", "share", "cases"), tuple(map(_row, found.items())), note),
        Table("Right answers by family", ("family", "share", "cases"), tuple(map(_row, _families(cases)))),
    ]


def write_source(folder: Path, source: str, cases: Sequence[Case]) -> Path:
    """Write `source.csv`, `source.md` and, last, `source.json`; returns the path of the last."""
    blocks = [("all", name, block) for name, block in figures(cases).items() if block["of"]]
    blocks += [("family", name, block) for name, block in _families(cases)]
    rows = [(source, of, name, *(block[key] for key in _KEYS)) for of, name, block in blocks]
    write_rows(folder / "source.csv", ("source", "of", "figure", *_KEYS), rows)
    write_whole(folder / "source.md", "\n\n".join(map(markdown_table, source_tables(source, cases))) + "\n")
    path = folder / "source.json"
    write_json(path, {"source": source, "figures": figures(cases), "cases": [dict(case) for case in cases]})
    return path


def _families(cases: Sequence[Case]) -> list[tuple[str, Block]]:
    names = sorted({c["family"] for c in cases})
    found = [(name, _rate(c for c in cases if c["family"] == name)) for name in names]
    return sorted(found, key=lambda item: item[1]["share"])


def _row(item: tuple[str, Block]) -> tuple[str, str, str]:
    name, block = item
    return name, f"{block['share']:.2f} [{block['low']:.2f}, {block['high']:.2f}]", str(block["of"])


def _rate(cases: Iterable[Case]) -> Block:
    return share(c["right"] for c in cases)


def _alarms(cases: Sequence[Case], kind: Callable[[str], bool]) -> Block:
    return share(not c["right"] for c in cases if kind(c["noise_kind"]))
