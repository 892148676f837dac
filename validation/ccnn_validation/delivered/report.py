"""Rows of figures as CSV and on screen, and their medians by kind."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ccnn_validation.delivered.judge import Figures

LIMITS = (1.1, 1.15)
"""Reached over reference, and what is measured after the correction over the promise."""


def write_csv(path: Path, rows: Sequence[Figures]) -> None:
    """All figures of all machines; a figure that a machine has not is empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def figures_of(row: Figures, form: str) -> dict[str, float]:
    """Ratios of a row by a form of its model: reached over reference, and √(reached² + noise²) over the promise.

    A promise is of the whole error, so that of a machine with fewer joints than coordinates is compared with `fixed`.
    A figure is missing where one of its parts is, and where the reference does not count.
    """
    found = {}
    for unit in ("mm", "mrad"):
        whole, noise = _number(row, f"{form}_inside_{row['whole']}{unit}"), _number(row, f"noise_{unit}")
        reached, reference = _number(row, f"{form}_inside_{unit}"), _number(row, f"reference_inside_{unit}")
        promised = _number(row, f"promised_{unit}")
        if reached and reference and row["reference_counts"]:
            found[f"reached/reference {unit}"] = reached / reference
        if whole and promised and noise:
            found[f"measured/promised {unit}"] = math.hypot(whole, noise) / promised
    return found


def kept(rows: Sequence[Figures], form: str, name: str, limit: float) -> tuple[int, int]:
    """How many machines have a ratio of at most the limit, of how many that have the ratio or should have it."""
    due = [row for row in rows if row["reference_counts"] or not name.startswith("reached")]
    if name.endswith("mrad"):
        due = [row for row in due if row["noise_mrad"]]
    return sum(figures_of(row, form).get(name, math.inf) <= limit for row in due), len(due)


def line(row: Figures, forms: Sequence[str]) -> str:
    """A machine in words: what it missed by, and what reference and program leave, position/rotation in mm/mrad."""
    parts = [
        f"{row['kind']} {row['seed']} ({row['extras'] or 'plain'}): before {_two(row, 'before')}",
        f"reference {_sets(row, 'reference')} jump {_text(_number(row, 'reference_jump'))}"
        f" (model {_two(row, 'reference_model')}, predicted {_two(row, 'reference_predicted')},"
        f" on the trained share {_two(row, 'predicted_on_trained_share')}"
        f"{'' if row['reference_counts'] else '; does not count'})",
        f"promised {_two(row, 'promised')} explained {_two(row, 'explained')} noise {_two(row, 'noise')}"
        f" in {_text(_number(row, 'seconds'))} s",
    ]
    for form in forms:
        if f"{form}_inside_mm" not in row:
            parts.append(f"{form}: no commands")
            continue
        parts.append(
            f"{form} {_sets(row, form)}, inside in fixed frames {_two(row, f'{form}_inside_fixed')},"
            f" jump {_text(_number(row, f'{form}_jump'))}, damped {row[f'{form}_inside_damped']:.0f} inside"
            f" {row[f'{form}_wrist_damped']:.0f} wrist, exact rows {_two(row, f'{form}_inside_exact')}"
        )
    if row["said"]:
        parts.append(f"said: {row['said']}")
    return "\n    ".join(parts)


def summary(rows: Sequence[Figures], form: str) -> str:
    """Medians by kind, position in mm, and how many machines hold the limits."""
    columns = {
        "before": "before_mm",
        "reference": "reference_inside_mm",
        "predicted": "reference_predicted_mm",
        "promised": "promised_mm",
        "inside": f"{form}_inside_mm",
        "edge": f"{form}_edge_mm",
        "outside": f"{form}_outside_mm",
        "wrist": f"{form}_wrist_mm",
        "jump": f"{form}_jump",
    }
    ratios = [f"{what} {unit}" for what in ("reached/reference", "measured/promised") for unit in ("mm", "mrad")]
    head = f"{'kind':<11}" + "".join(f"{name:>10}" for name in columns) + "   " + "  ".join(ratios)
    lines = [
        f"Commands by {form}; medians, mm; reached/reference <= {LIMITS[0]}, measured/promised <= {LIMITS[1]}",
        head,
    ]
    for kind in [*dict.fromkeys(str(row["kind"]) for row in rows), "all"]:
        mine = [row for row in rows if kind in ("all", row["kind"])]
        cells = [_median([_number(row, column) for row in mine]) for column in columns.values()]
        text = f"{kind:<11}" + "".join(f"{_text(cell):>10}" for cell in cells) + "   "
        for name in ratios:
            middle = _median([figures_of(row, form).get(name) for row in mine])
            good, due = kept(mine, form, name, LIMITS[0] if name.startswith("reached") else LIMITS[1])
            text += f"{_text(middle)} ({good}/{due})".ljust(len(name) + 2)
        lines.append(text.rstrip())
    return "\n".join(lines)


def _sets(row: Figures, who: str) -> str:
    return ", ".join(f"{name} {_two(row, f'{who}_{name}')}" for name in ("inside", "edge", "outside", "wrist"))


def _two(row: Figures, name: str) -> str:
    return f"{_text(_number(row, f'{name}_mm'))}/{_text(_number(row, f'{name}_mrad'))}"


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _number(row: Figures, name: str) -> float | None:
    value = row.get(name)
    return float(value) if isinstance(value, (int, float)) else None


def _median(values: Sequence[float | None]) -> float | None:
    there = [v for v in values if v is not None]
    return float(np.median(there)) if there else None
