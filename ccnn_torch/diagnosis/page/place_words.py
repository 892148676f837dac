"""Where the gap is, in words: the joints, the region of the workspace, and the conditions that hold most of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ccnn_torch.diagnosis.page.data import About
from ccnn_torch.diagnosis.page.localisation import regime_words, row_parts
from ccnn_torch.diagnosis.verdict.findings import places
from ccnn_torch.diagnosis.verdict.text import listed
from ccnn_torch.effects import OUTLIER

Block = Mapping[str, Any]

# Joints that are named, and the share from which.
_MOST_JOINTS, _JOINT = 3, 0.1
# Share of the gap from which a phase of a motion is named.
_PHASE = 0.2
# Times the share of the rows from which a region holds more of the gap than others.
_MORE = 1.5
# Of the distances of all regions from the base: a region among the nearest or farthest third is called so, where the
# distances differ by this share.
_APART = 0.1
# Beyond the share of its rows at 95 %: from there on a condition matters.
_BEYOND = 0.1
# Ranges below this many metres are told in mm.
_SMALL = 0.5


def where_words(results: Block, about: About) -> list[str]:
    """Up to three sentences without a full stop; none where there is no gap beside the noise and bad rows.

    Args:
        results: as in `diagnosis.json`.
        about: for the units of covariates.
    """
    if results["verdict"]["none"] or results["verdict"]["effects"] == [OUTLIER]:
        return []
    said = []
    joints = sorted(results["where"]["joints"].items(), key=lambda item: -item[1])
    most = [(n, s) for n, s in joints if s >= _JOINT][:_MOST_JOINTS]
    if len(joints) > 1 and most:
        shares = listed([f"{places([_joint(name)])} {100 * share:.0f} %" for name, share in most])
        said.append(f"{shares} of the gap")
    if phase := _phase(results["where"].get("phases", {})):
        said.append(phase)
    if region := _region(results["where"]["regions"]):
        said.append(region)
    if regime := _regime(results, about):
        said.append(regime)
    return said


def _joint(name: str) -> str:
    return f"joint {name.removeprefix('joint ').removeprefix('q')}"


def _phase(phases: Mapping[str, Any]) -> str:
    """The phase of a motion that holds most of the gap for its time; empty where none stands out."""
    there = {n: p for n, p in phases.items() if p["share"] >= _PHASE and p["samples"] > 0}
    if not there:
        return ""
    name = max(there, key=lambda n: there[n]["share"] / there[n]["samples"])
    share, part = there[name]["share"], there[name]["samples"]
    words = {"standstill": "at standstill", "reversal": "around reversals", "fast": "in fast motion"}
    text = f"{100 * share:.0f} % of it {words.get(name, 'in slow motion')} ({100 * part:.0f} % of the time)"
    return text if share > _MORE * part else "spread over all phases of the motion"


def _region(regions: list[Block]) -> str:
    """The region that holds most of the gap, in the robot's frame; empty where the gap is spread evenly."""
    if not regions:
        return ""
    rows = sum(r["rows"] for r in regions)
    worst = max(regions, key=lambda r: r["share"])
    part = worst["rows"] / rows
    if worst["share"] < _MORE * part:
        return "spread over the whole workspace"
    names = [n for n in worst["center"] if n in "xyz"]
    wide = max(worst["half_width"][n] for n in names) if names else 0.0
    scale, unit, digits = (1e-3, "mm", 0) if wide < _SMALL / 2 else (1.0, "m", 2)
    ranges = []
    for n in names:
        ends = ((worst["center"][n] + side * worst["half_width"][n]) / scale for side in (-1, 1))
        low, high = (f"{end:.{digits}f}" for end in ends)
        ranges.append(f"{n} {low} to {high} {unit}")
    far = _distance(regions, worst, names)
    text = ", ".join([*ranges, *([far] if far else [])])
    return f"{100 * worst['share']:.0f} % of it in {100 * part:.0f} % of the rows: {text}" if text else ""


def _distance(regions: list[Block], worst: Block, names: list[str]) -> str:
    """How far from the base a region is among all of them."""
    away = sorted(math.hypot(*(r["center"][n] for n in names)) for r in regions)
    own = math.hypot(*(worst["center"][n] for n in names))
    if len(away) < 3 or away[-1] - away[0] < _APART * away[-1]:
        return ""
    third = len(away) // 3
    return "far from the base" if own >= away[-third] else "near the base" if own <= away[third - 1] else ""


def _regime(results: Block, about: About) -> str:
    """The condition under which the gap is largest, where one stands out."""
    found = []
    for name, regimes in results["where"]["covariates"].items():
        intervals = results.get("where_ci95", {}).get("covariates", {}).get(name) or []
        for regime, part, interval in zip(regimes, row_parts(regimes), intervals, strict=False):
            found.append((interval[0] - part, part, regime, name))
    if not found:
        return ""
    beyond, part, regime, name = max(found, key=lambda item: item[0])
    if beyond < _BEYOND:
        return ""
    where = regime_words(name, regime, about.unit(name))
    return f"{100 * regime['share']:.0f} % of it in {100 * part:.0f} % of the rows: {where}"
