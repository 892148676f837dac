"""Whether an answer is right, by the truth and by what these rows can identify.

An answer is *right* where its names explain the true gap as well as the true causes do, with no more names, to within
the noise (`Judge.as_well`): then the data cannot distinguish it from the truth, whether it is the truth, one of its
class, or one name for a pair. What is outside the library is right where the answer says so and names the driver.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ccnn_validation.blind.case import BlindCase
from ccnn_validation.blind.explain import Judge

__all__ = ["judged"]

_OUTLIER = "outlier"
_CLEAR = 1.0
"""What the library leaves of a cause at best, in units of the noise's squares, from which on "and something outside of
it" is no mistake."""

_HIDDEN = 2.0
"""Standard deviations of the noise's sum of squares up to which something left is seen by no test that does not know
what it looks for."""


def judged(case: BlindCase, answer: Mapping[str, Any] | None, withheld: Mapping[str, Any] | None) -> dict[str, Any]:
    """Judgement of a case's answer, and of the answer without the effect that was there (single causes).

    Args:
        case: with its truth.
        answer: diagnosis.json, or `{"failed": sentence}`.
        withheld: likewise, or None where there is none.
    """
    judge = Judge(case)
    causes = [c for c in case.plan.causes if c in judge.names] if case.plan.kind != "outside" else []
    found: dict[str, Any] = {"class": judge.members(causes) if causes else []}
    if causes:
        best = judge.explained(causes)
        found["library_leaves"] = best.left / judge.numbers
    assert answer is not None, "judged before it was diagnosed"
    if "failed" in answer:
        return {**found, "answer": {"failed": answer["failed"]}, "withheld": None}
    return {
        **found,
        "answer": _answer(case, judge, causes, answer),
        "withheld": _withheld(case, judge, causes, withheld) if withheld is not None else None,
    }


def _answer(case: BlindCase, judge: Judge, causes: Sequence[str], answer: Mapping[str, Any]) -> dict[str, Any]:
    verdict = answer["verdict"]
    names, outside = list(verdict["effects"]), bool(verdict["outside_library"])
    kind = case.plan.kind
    exact = set(names) == set(case.plan.causes) and not outside
    common = {
        "effects": names,
        "probability": verdict["probability"],
        "outside": outside,
        "driver": verdict["driver"],
        "listed": sorted(
            {other for e in answer["effects"] if e["name"] in names for other in e["indistinguishable_from"]}
        ),
        "seconds": answer.get("seconds"),
    }
    if kind == "none":
        right = not names and not outside
        return {**common, "exact": right, "right": right, "found": 0, "shrink": None}
    if kind == "outside":
        right = outside and verdict["driver"] in case.drivers[0]
        bare = right and not set(names) - {_OUTLIER}
        return {**common, "exact": bare, "right": right, "found": int(outside), "shrink": None}
    if case.plan.causes == (_OUTLIER,):
        return {**common, "exact": exact, "right": exact, "found": int(_OUTLIER in names), "shrink": None}
    named = [n for n in names if n != _OUTLIER]
    bearable = not outside or judge.explained(causes).left > _CLEAR * judge.numbers
    explains = bool(named) and len(named) <= len(causes) and judge.as_well(named, causes)
    return {
        **common,
        "exact": exact or (set(named) == set(causes) and bearable),
        "right": explains and bearable,
        "named": explains,
        "found": sum(_found(cause, named, causes, judge) for cause in causes),
        "shrink": _shrink(verdict, judge.explained(named).shrink(answer.get("rows_set_aside", ()))) if named else None,
    }


def _found(cause: str, named: Sequence[str], causes: Sequence[str], judge: Judge) -> bool:
    """Whether a true cause is named, or one that these rows cannot distinguish from it."""
    if cause in named or (named and judge.as_well(named, causes)):
        return True
    others = [c for c in causes if c != cause]
    return any(judge.as_well([*others, name], causes) for name in named if name not in causes)


def _shrink(verdict: Mapping[str, Any], true: float) -> dict[str, Any] | None:
    """The interval of the shrink, and whether it holds the one that noise-free data show."""
    interval = verdict["shrink_ci95"]
    if interval is None or interval[0] is None:
        return None
    low, high = interval
    return {"true": true, "said": verdict["shrink"], "low": low, "high": high, "holds": low <= true <= high}


def _withheld(case: BlindCase, judge: Judge, causes: Sequence[str], answer: Mapping[str, Any]) -> dict[str, Any] | None:
    """The answer of a library that lacks the cause: right is "outside", or names that explain the gap as well."""
    if "failed" in answer:
        return {"failed": answer["failed"]}
    if len(causes) != 1:
        return None
    verdict = answer["verdict"]
    names, outside, driver = list(verdict["effects"]), bool(verdict["outside_library"]), verdict["driver"]
    named = [n for n in names if n != _OUTLIER]
    explains = bool(named) and judge.as_well(named, causes)
    own = case.drivers[0]
    return {
        "effects": names,
        "probability": verdict["probability"],
        "outside": outside,
        "driver": driver,
        "own_driver": bool(own),
        "right": explains or (outside and (not own or driver in own)),
        "wrong_name": bool(named) and not explains and not outside and verdict["probability"] > 0.9,
        "hidden": bool(named) and judge.explained(named).left <= _HIDDEN * math.sqrt(2 * judge.numbers),
    }
