"""Figures of a blind check: how often a diagnosis is right, and how reliable its probabilities are.

Every share has its 95 % interval (Clopper and Pearson 1934).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from ccnn_torch.files.write import write_rows, write_whole
from ccnn_torch.report.json_files import write_json
from ccnn_validation.blind.tables import blind_markdown

__all__ = ["share", "summary", "write_blind"]

Case = Mapping[str, Any]
Block = dict[str, Any]

_EDGES = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
"""Of the bins in which claimed probabilities are compared with how often they were right."""
_CONFIDENT = 0.95
DEFINITIONS = {
    "right": "the names explain the true gap as well as the true causes, with no more names, to within the noise; what "
    "is outside the library is called outside and by its driver; nothing is found where there is nothing",
    "exact": "the true names and no other",
    "found": "share of the true causes that are named, or represented by one that these rows cannot distinguish",
    "class": "names that explain the true gap as well as the true cause does",
    "claims": "verdicts with a probability of 0.95 or more that are right",
    "wrong_name": "a name with a probability above 0.9 that does not explain the gap",
    "hidden": "the names leave less than two standard deviations of the noise's own squares, which no test sees that "
    "does not know the cause",
    "shrink": "95 % intervals of the shrink that hold the one that noise-free data show for the same names",
}


def share(hits: Iterable[bool]) -> Block:
    """How many of how many, the share, and its 95 % interval; the share is None of none."""
    outcomes = list(hits)
    count, of = sum(map(bool, outcomes)), len(outcomes)
    if not of:
        return {"count": 0, "of": 0, "share": None, "low": None, "high": None}
    interval = binomtest(count, of).proportion_ci(0.95, method="exact")
    return {"count": count, "of": of, "share": count / of, "low": float(interval.low), "high": float(interval.high)}


def summary(cases: Sequence[Case]) -> Block:
    """The content of `blind.json`."""
    kinds = {kind: [c for c in cases if c["kind"] == kind] for kind in ("single", "pair", "none", "outside")}
    single = [c for c in kinds["single"] if c["causes"] != ["outlier"]]
    lone = [c for c in single if c["class"] == c["causes"]]
    withheld = [c for c in single if c["withheld"] is not None and "failed" not in c["withheld"]]
    found: Block = {
        "cases": len(cases),
        "failed": [
            {"number": c["number"], "sentence": c["answer"]["failed"]} for c in cases if "failed" in c["answer"]
        ],
        "targets": {
            "single, right": _rate(single, "right"),
            "single of its own class, exact": _rate(lone, "exact"),
            "single, exact": _rate(single, "exact"),
            "bad rows, exact": _rate([c for c in kinds["single"] if c["causes"] == ["outlier"]], "exact"),
            "pair, right": _rate(kinds["pair"], "right"),
            "pair, exact": _rate(kinds["pair"], "exact"),
            "pair, found": _recall(kinds["pair"]),
            "none, false alarms": share(not _is(c, "right") for c in kinds["none"]),
            "outside, right driver": _rate(kinds["outside"], "right"),
            "outside, right driver and no name beside": _rate(kinds["outside"], "exact"),
            "outside, said": share(bool(c["answer"].get("outside")) for c in kinds["outside"]),
            "withheld with a driver of its own, right": _kept(withheld, lambda w: w["own_driver"], "right"),
            "withheld without, right": _kept(withheld, lambda w: not w["own_driver"], "right"),
            "withheld without, right or hidden": share(
                w["right"] or w.get("hidden", False) for c in withheld if not (w := c["withheld"])["own_driver"]
            ),
            "withheld, wrong name": _kept(withheld, lambda w: True, "wrong_name"),
            "claims": share(_is(c, "right") for c in cases if _probability(c) >= _CONFIDENT),
            "shrink": share(c["answer"]["shrink"]["holds"] for c in cases if c["answer"].get("shrink")),
        },
        "by_strength": _grouped(single + kinds["pair"] + kinds["outside"], lambda c: f"{c['strength']:g}"),
        "by_machine": _grouped(cases, lambda c: c["machine"]),
        "by_rows": _grouped(cases, lambda c: str(c["rows"])),
        "by_disturbance": _grouped(cases, lambda c: c["disturbance"] or "none"),
        "by_noise": _grouped(cases, lambda c: "given" if c["noise_told"] else "not given"),
        "by_cause": _by_cause(kinds),
        "confusion": _confusion(kinds),
        "reliability": _reliability(cases),
        "withheld": _withheld(withheld),
        "seconds": sorted(c["answer"]["seconds"] for c in cases if c["answer"].get("seconds") is not None),
        "seconds_by_machine": _seconds(cases),
        "definitions": DEFINITIONS,
    }
    return found


def _seconds(cases: Sequence[Case]) -> Block:
    """How long the diagnoses of the longest records took, by machine."""
    timed = [c for c in cases if c["answer"].get("seconds") is not None]
    rows = max((c["rows"] for c in timed), default=0)
    found: Block = {"rows": rows, "machines": {}}
    for machine in sorted({c["machine"] for c in timed}):
        took = sorted(c["answer"]["seconds"] for c in timed if (c["machine"], c["rows"]) == (machine, rows))
        if took:
            median, ninth = (float(np.quantile(took, q)) for q in (0.5, 0.9))
            within = share(s < 1 for s in took)
            found["machines"][machine] = {
                "median": median,
                "ninth_decile": ninth,
                "most": took[-1],
                "below_1_s": within,
            }
    return found


def _is(case: Case, what: str) -> bool:
    """A case without an answer is not right."""
    return bool(case["answer"].get(what, False))


def _probability(case: Case) -> float:
    return float(case["answer"].get("probability") or 0.0)


def _rate(cases: Iterable[Case], what: str) -> Block:
    return share(_is(c, what) for c in cases)


def _recall(cases: Sequence[Case]) -> Block:
    return share(i < c["answer"].get("found", 0) for c in cases for i in range(len(c["causes"])))


def _kept(cases: Sequence[Case], which: Callable[[Mapping[str, Any]], bool], what: str) -> Block:
    return share(c["withheld"][what] for c in cases if which(c["withheld"]))


def _grouped(cases: Sequence[Case], key: Callable[[Case], str]) -> dict[str, Block]:
    """Right answers by group and kind."""
    groups: dict[str, dict[str, list[Case]]] = {}
    for case in cases:
        groups.setdefault(key(case), {}).setdefault(case["kind"], []).append(case)
    order = sorted(groups, key=lambda k: (0, float(k), k) if k.replace(".", "").isdigit() else (1, 0.0, k))
    return {k: {kind: _rate(members, "right") for kind, members in groups[k].items()} for k in order}


def _by_cause(kinds: Mapping[str, Sequence[Case]]) -> dict[str, Block]:
    """Of each cause: right and exact where it was alone, found in pairs, and what the library leaves of it."""
    names = sorted({cause for kind in ("single", "pair") for c in kinds[kind] for cause in c["causes"]})
    found = {}
    for name in names:
        alone = [c for c in kinds["single"] if c["causes"] == [name]]
        left = sorted(c["library_leaves"] for c in alone if c.get("library_leaves") is not None)
        found[name] = {
            "right": _rate(alone, "right"),
            "exact": _rate(alone, "exact"),
            "pair_right": _rate([c for c in kinds["pair"] if name in c["causes"]], "right"),
            "library_leaves": left[len(left) // 2] if left else None,
        }
    return found


def _verdict(case: Case) -> str:
    """A verdict in a word."""
    answer = case["answer"]
    if "failed" in answer:
        return "failed"
    names = " + ".join(answer["effects"])
    if answer["outside"]:
        return " + ".join([*([names] if names else []), f"outside ({answer['driver']})"])
    return names or "none"


def _confusion(kinds: Mapping[str, Sequence[Case]]) -> dict[str, dict[str, int]]:
    """True single cause (or none, or outside by its driver) -> verdict -> cases; right ones of a class as they are."""
    table: dict[str, dict[str, int]] = {}
    for kind in ("single", "none", "outside"):
        for case in kinds[kind]:
            true = (
                case["causes"][0] if kind == "single" else "none" if kind == "none" else f"outside: {case['causes'][0]}"
            )
            row = table.setdefault(true, {})
            row[_verdict(case)] = row.get(_verdict(case), 0) + 1
    return {k: dict(sorted(row.items(), key=lambda item: -item[1])) for k, row in sorted(table.items())}


def _reliability(cases: Sequence[Case]) -> list[Block]:
    """Claimed probability against how often it was right, by bins of the claim."""
    claims = [(_probability(c), _is(c, "right")) for c in cases if "failed" not in c["answer"]]
    bins = []
    for low, high in pairwise(_EDGES):
        inside = [(p, r) for p, r in claims if low <= p and (p < high or high == _EDGES[-1])]
        mean = sum(p for p, _ in inside) / len(inside) if inside else None
        bins.append({"from": low, "to": high, "claimed": mean, "right": share(r for _, r in inside)})
    return bins


def _withheld(cases: Sequence[Case]) -> dict[str, Block]:
    """By the effect that the library lacked."""
    names = sorted({c["causes"][0] for c in cases})
    groups = {name: [c["withheld"] for c in cases if c["causes"] == [name]] for name in names}
    return {
        name: {"right": share(w["right"] for w in g), "wrong_name": share(w["wrong_name"] for w in g)}
        for name, g in groups.items()
    }


def write_blind(folder: Path, found: Mapping[str, Any]) -> Path:
    """Write `blind.csv`, `blind.md` and, last, `blind.json`; returns the path of the last."""
    header = ("group", "of", "figure", "count", "cases", "share", "low", "high")
    write_rows(folder / "blind.csv", header, _tidy(found))
    write_whole(folder / "blind.md", blind_markdown(found))
    path = folder / "blind.json"
    write_json(path, found)
    return path


def _tidy(found: Mapping[str, Any]) -> Iterable[tuple[Any, ...]]:
    """One row a share."""

    def row(group: str, of: str, figure: str, block: Mapping[str, Any]) -> tuple[Any, ...]:
        return (group, of, figure, *(block[key] for key in ("count", "of", "share", "low", "high")))

    for figure, block in found["targets"].items():
        yield row("all", "", figure, block)
    for group in ("by_strength", "by_machine", "by_rows", "by_disturbance", "by_noise"):
        for of, kinds in found[group].items():
            for kind, block in kinds.items():
                yield row(group, of, f"{kind}, right", block)
    for of, figures in found["by_cause"].items():
        for figure in ("right", "exact", "pair_right"):
            yield row("by_cause", of, figure, figures[figure])
    for of, figures in found["withheld"].items():
        for figure, block in figures.items():
            yield row("withheld", of, figure, block)
    for bin_ in found["reliability"]:
        yield row("reliability", f"{bin_['from']:g} to {bin_['to']:g}", "right", bin_["right"])
