"""Figures of many machines as one: the median, and the 5 % and 95 % quantiles in `spread`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.display import number_text
from ccnn_torch.mechanisms import PoseError

_LOW, _HIGH = 0.05, 0.95


def figures(values: Mapping[str, Tensor | None]) -> dict[str, Any]:
    """One number for each key, and `spread: {key: [low, high]}` where there are several machines.

    Args:
        values: `r` each; None, or a tensor without a finite number, gives None.
    """
    numbers: dict[str, Any] = {}
    spread: dict[str, list[float]] = {}
    for key, table in values.items():
        known = None if table is None else table[torch.isfinite(table)]
        if table is None or known is None or len(known) == 0:
            numbers[key] = None
            continue
        numbers[key] = float(known.quantile(0.5))
        if len(table) > 1:
            spread[key] = [float(known.quantile(_LOW)), float(known.quantile(_HIGH))]
    return numbers | ({"spread": spread} if spread else {})


def figure_text(block: Mapping[str, Any] | None, key: str, scale: float = 1.0, digits: int = 3) -> str:
    """One of the `figures` with its interval, or –."""
    if block is None or block.get(key) is None:
        return "–"
    text = number_text(block[key] / scale, digits)
    spread = block.get("spread", {}).get(key)
    if spread is not None:
        low, high = (number_text(v / scale, digits) for v in spread)
        text += f" [{low}, {high}]"
    return text


def before_and_after(before: PoseError, after: PoseError, noise: PoseError | None = None) -> dict[str, Any]:
    """Position and rotation: RMS and maximum over the poses of a machine, before and after.

    Args:
        before, after: `r x t`.
        noise: of the measurement, `r x t`, where it is known.
    """
    answer: dict[str, Any] = {}
    for name, unit, first, last, floor in zip(
        PoseError._fields, ("m", "rad"), before, after, noise or (None, None), strict=True
    ):
        if first is None or last is None or float(first.abs().nan_to_num().max()) == 0:
            answer[name] = None
            continue
        entries: dict[str, Tensor | None] = {
            "before": _rms(first),
            "after": _rms(last),
            "max_before": first.amax(-1),
            "max_after": last.amax(-1),
        }
        if floor is not None:
            entries["noise"] = _rms(floor)
        answer[name] = {"unit": unit} | figures(entries)
    return answer


def removed(before: PoseError, after: PoseError) -> dict[str, Any]:
    """As `before_and_after`, with the share of the RMS that was removed."""
    answer = before_and_after(before, after)
    for name, first, last in zip(PoseError._fields, before, after, strict=True):
        if answer[name] is None or first is None or last is None:
            continue
        share = figures({"removed": 1 - _rms(last) / _rms(first)})
        answer[name]["removed"] = share["removed"]
        if "spread" in share:
            answer[name]["spread"] |= share["spread"]
    return answer


def _rms(values: Tensor) -> Tensor:
    """`r x t` -> `r`."""
    return values.square().mean(-1).sqrt()
