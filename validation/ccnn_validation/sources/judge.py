"""Whether an answer is right, by what a source said beforehand."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ccnn_validation.sources.case import Truth

__all__ = ["follows", "judged"]

_OUTLIER = "outlier"
_SURE = 0.9
"""Probability above which a wrong name is counted."""


def judged(truth: Truth, answer: Mapping[str, Any], baseline: Mapping[str, Any] | None) -> dict[str, Any]:
    """Judgement of an answer.

    Args:
        truth: of the case.
        answer: diagnosis.json, or `{"failed": sentence}`.
        baseline: of the same rows without the cause, where the truth is what is gained.
    """
    if "failed" in answer or "failed" in (baseline or {}):
        failed = str(answer.get("failed") or (baseline or {})["failed"])
        right = bool(truth.mention) and _mentions(truth, failed)
        return {"failed": failed, "right": right, "exact": right, "found": right, "wrong_name": False, "probability": 0}
    verdict = answer["verdict"]
    names, outside = frozenset(verdict["effects"]), bool(verdict["outside_library"])
    # Earlier versions name one driver.
    drivers = verdict.get("drivers") or [verdict["driver"]] * bool(verdict["driver"])
    before = frozenset(baseline["verdict"]["effects"]) if baseline is not None else frozenset()
    gained = names - before
    named = gained in truth.accepted or (baseline is not None and names in truth.accepted)
    said = truth.outside is None or outside == truth.outside or (baseline is not None and truth.outside is False)
    said = said or gained in truth.enough
    driven = not outside or truth.outside is False or not truth.drivers or follows(drivers, truth)
    texts = " ".join([*answer["cautions"], *answer["notes"], verdict["text"]]).lower()
    if frozenset({_OUTLIER}) in truth.accepted and not gained and (names or outside):
        # Bad rows are the verdict only where they are the only finding: else they have to be set aside.
        named = len(answer["rows_set_aside"]) > len((baseline or {"rows_set_aside": ()})["rows_set_aside"])
    right = named and said and driven
    if truth.mention:
        right = _mentions(truth, texts)
    allowed = frozenset().union(*truth.accepted)
    probability = float(verdict["probability"])
    return {
        "names": sorted(names),
        "gained": sorted(gained),
        "outside": outside,
        "drivers": list(drivers),
        "probability": probability,
        "right": right,
        "exact": right and (baseline is not None or not outside or truth.outside is True),
        "found": any(accepted <= names for accepted in truth.accepted) and (truth.outside is not True or outside),
        "wrong_name": bool(gained - allowed) and probability > _SURE and not right,
    }


def follows(drivers: Sequence[str], truth: Truth) -> bool:
    """Whether one of a verdict's drivers (`joint q2`, `load x`, `workspace`) is a right one."""
    parts = [_plain(driver) for driver in drivers]
    wanted = [_plain(d) for d in truth.drivers]
    return any(p == w or p.startswith(w + "_") or (p != "" and w.startswith(p + "_")) for p in parts for w in wanted)


def _plain(driver: str) -> str:
    text = driver.lower().removeprefix("joint ").strip()
    text = re.sub(r"^(direction|speed) ?_?(?=\d)", r"\1_", text)
    return {"workspace": "position"}.get(text, text.replace(" ", "_"))


def _mentions(truth: Truth, text: str) -> bool:
    return any(word.lower() in text.lower() for word in truth.mention)
