"""Numbers of a report as people read them; what every floor needs of it stands in `_display`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ccnn_torch._display import count_text as count_text
from ccnn_torch._display import display_unit as display_unit
from ccnn_torch._display import number_text as number_text

__all__ = ["count_text", "display_unit", "interval_text", "number_text", "removed_percent"]


def interval_text(spread: Mapping[str, Any] | None, scale: float = 1.0, digits: int = 4) -> str:
    """A spread as `median [low, high]`, or as one number when all repeats agree; says how many repeats have none.

    Args:
        spread: a block of `results.json`, or None.
        scale: the unit shown [SI].
        digits: significant digits of the median; the interval has one less.
    """
    if spread is None or spread["median"] is None:
        return "–"
    text = number_text(spread["median"] / scale, digits)
    values = spread["values"]
    if spread["low"] != spread["high"]:
        low, high = (number_text(spread[k] / scale, digits - 1) for k in ("low", "high"))
        text += f" [{low}, {high}]"
    there = sum(v is not None for v in values)
    return text if there == len(values) else f"{text} ({there} of {len(values)})"


def removed_percent(before: Mapping[str, Any], after: Mapping[str, Any]) -> float | None:
    """Share of an error that was removed, from the medians [percent]; None where the error before is unknown or 0."""
    if not before["median"] or after["median"] is None:
        return None
    return 100.0 * (1.0 - float(after["median"]) / float(before["median"]))
