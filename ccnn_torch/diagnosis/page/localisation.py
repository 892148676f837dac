"""Tables of a diagnosis by place: where the gap lies, what to measure next, which rows were set aside."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.diagnosis.page.data import NEXT, About, used_rows
from ccnn_torch.diagnosis.page.tables import percent, percent_interval
from ccnn_torch.display import display_unit, number_text, unit_text
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.table import Table

Block = Mapping[str, Any]
_KELVIN = 273.15
# Unit that a controller shows in the place of that of the SI, the factor and what is added.
_SHOWN = {"m": ("mm", 1e3, 0.0), "rad": ("deg", 180 / math.pi, 0.0), "K": ("degC", 1.0, -_KELVIN)}
_SHARES = ("share of the gap [%]", "95 % interval [%]")
# More joints and conditions than this do not fit side by side on a page.
_MOST_COLUMNS = 8
_SHARE = "Share: of the gap's mean square that lies there."


def quantity_text(value: float, unit: str, digits: int = 4) -> str:
    """A joint, a coordinate or a covariate with its unit: lengths in mm, temperatures in °C."""
    if unit == "K":
        return f"{value - _KELVIN:.1f} °C"
    # Always mm, so that the ends of a range have one unit.
    scale, shown = (1e-3, "mm") if unit == "m" else (1.0, unit_text(unit))
    number = value / scale
    text = f"{number:.0f}" if abs(number) >= 10**digits else f"{number:.{digits}g}"
    return f"{text} {shown}".removesuffix(" 1")


def shares(results: Block, about: About) -> Iterator[tuple[str, str, float, list[float] | None]]:
    """Every share of `where` but the regions': group, part, share, and its interval or None."""
    where, known = results["where"], results.get("where_ci95", {})
    for group, single in (("outputs", "output"), ("joints", "joint"), ("legs", "leg")):
        for name, share in where[group].items():
            part = name if name.startswith(single) else f"{single} {name}"
            yield group, part, share, known.get(group, {}).get(name)
    for name, phase in where.get("phases", {}).items():
        part = f"{name} ({100 * phase['samples']:.0f} % of the time)"
        yield "phases", part, phase["share"], known.get("phases", {}).get(name)
    for name, regimes in where["covariates"].items():
        intervals = known.get("covariates", {}).get(name) or [None] * len(regimes)
        for regime, interval in zip(regimes, intervals, strict=True):
            yield name, regime_words(name, regime, about.unit(name)), regime["share"], interval


def _share_note(results: Block) -> str:
    if results["verdict"]["none"]:
        return _SHARE + " There is no gap above the noise: these are shares of the noise."
    return _SHARE


def regime_words(name: str, regime: Block, unit: str) -> str:
    """A covariate with the range or the value of one of its regimes."""
    if regime["from"] == regime["to"]:
        return f"{name} {quantity_text(regime['from'], unit, 3)}"
    low, high = (quantity_text(regime[key], unit, 3) for key in ("from", "to"))
    return f"{name} {low} to {high}"


def row_parts(regimes: Sequence[Block]) -> list[float]:
    """Of each regime of a covariate its share of the rows; alike where a file of an earlier version does not tell."""
    rows = [regime.get("rows", 1) for regime in regimes]
    return [count / max(sum(rows), 1) for count in rows]


def where_table(results: Block, about: About, *, telling: bool = False) -> Table | None:
    """Shares of the gap by output, joint, leg, covariate regime and phase of a motion.

    Args:
        telling: leave covariates out none of whose regimes differs from the share of its rows.
    """
    found = list(shares(results, about))
    hidden = []
    for name, regimes in results["where"]["covariates"].items():
        intervals = [interval for group, _, _, interval in found if group == name]
        parts = zip(intervals, row_parts(regimes), strict=True)
        even = all(i is not None and i[0] <= part <= i[1] for i, part in parts)
        hidden += [name] if telling and even else []
    rows = [
        (part, percent(share), percent_interval(interval))
        for group, part, share, interval in found
        if group not in hidden
    ]
    if not rows:
        return None
    note = _share_note(results)
    if hidden:
        note += f" Not shown: {', '.join(hidden)}, over which these rows show no difference in the gap."
    return Table("Where is the gap?", ("part", *_SHARES), rows, note)


def region_table(results: Block, about: About) -> Table | None:
    """Shares of the gap by region of the workspace, the largest first."""
    regions = results["where"]["regions"]
    if not regions:
        return None
    names = list(regions[0]["center"])
    intervals = results.get("where_ci95", {}).get("regions") or [None] * len(regions)
    rows = []
    for region, interval in sorted(zip(regions, intervals, strict=True), key=lambda pair: -pair[0]["share"]):
        cells = []
        for name in names:
            middle, half = region["center"][name], region["half_width"][name]
            low, high = (quantity_text(middle + side * half, about.unit(name)) for side in (-1, 1))
            cells.append(f"{low} to {high}")
        rows.append((*cells, percent(region["share"]), percent_interval(interval), str(region["rows"])))
    columns = (*names, *_SHARES, "rows")
    return Table("In which region?", columns, rows, "Largest share first. " + _share_note(results))


def next_table(results: Block, about: About) -> Table | None:
    """What to measure next, most informative first: a row each, or a column each where it has many values."""
    wanted = results["next_measurements"]
    if not wanted:
        return None
    if results.get("motion"):
        return _next_motion_table(wanted)
    joints, covariates = _columns(results)
    rows = []
    for number, entry in enumerate(wanted, 1):
        cells = [quantity_text(entry["joints"][n], about.unit(n)) for n in joints]
        cells += [
            quantity_text(entry["covariates"][n], about.unit(n)) if n in entry["covariates"] else "–"
            for n in covariates
        ]
        rows.append((str(number), *cells, " or ".join(entry["separates"]) or "–", number_text(entry["gain"], 3)))
    columns = ("number", *joints, *covariates, "separates", "gain [nat]")
    rivals = any(entry["separates"] for entry in wanted)
    aim = "which explanation is right" if rivals else "the numbers of the one explanation, which has no rival"
    note = f"Gain: expected information on {aim}. The same as a file: next_measurements.csv."
    if len(joints) + len(covariates) > _MOST_COLUMNS:
        columns, *rows = zip(columns, *rows, strict=True)
    return Table("What should be measured next?", columns, rows, note, ("separates",))


def _next_motion_table(wanted: Sequence[Block]) -> Table:
    rows = [
        (
            str(k),
            e["motion"]["joint"],
            e["motion"]["text"],
            " or ".join(e["separates"]) or "–",
            number_text(e["gain"], 3),
        )
        for k, e in enumerate(wanted, 1)
    ]
    note = (
        "Gain: expected log odds by which the motion tells the two apart, or where there is no rival the information "
        f"on the numbers of the only model. The first as commands to play: {NEXT}."
    )
    columns = ("number", "joint", "motion", "separates", "gain [nat]")
    return Table("What should be recorded next?", columns, rows, note, ("motion", "separates"))


def write_next_csv(path: Path, results: Block, about: About) -> None:
    """Write `next_measurements.csv` in a controller's units (mm, deg, degC), the header being `name[unit]`.

    A covariate that a measurement does not ask for is empty.
    """
    joints, covariates = _columns(results)
    names = (*joints, *covariates)
    shown = {name: _SHOWN.get(about.unit(name), (about.unit(name), 1.0, 0.0)) for name in names}
    rows: list[list[float | None]] = []
    for entry in results["next_measurements"]:
        values = {**entry["joints"], **entry["covariates"]}
        scaled = {name: shown[name][1] * value + shown[name][2] for name, value in values.items()}
        rows.append([*(scaled.get(name) for name in names), entry["gain"]])
    write_rows(path, [*(f"{name}[{shown[name][0]}]" for name in names), "gain[1]"], rows)


def _columns(results: Block) -> tuple[list[str], list[str]]:
    """Names of the joints and covariates that any of the next measurements sets, in the order of their first use."""
    joints, covariates = (
        list(dict.fromkeys(name for entry in results["next_measurements"] for name in entry[key]))
        for key in ("joints", "covariates")
    )
    return joints, covariates


def aside_table(results: Block, arrays: Mapping[str, NDArray[np.float64]], about: About) -> Table | None:
    """Rows that were set aside, by their lines in the file, how far they are off, and why."""
    numbers = results["rows_set_aside"]
    if not numbers:
        return None
    columns, cells = ["row"], [[str(number + 1)] for number in numbers]
    note = "The first row is row 1 (0 in diagnosis.json)."
    if len(about.lines) == len(numbers):
        columns, cells = ["line", "row"], [[str(line), *cell] for line, cell in zip(about.lines, cells, strict=True)]
        note = "Line: of the file, the header being line 1; the row below it is row 1 (0 in diagnosis.json)."
    residual = arrays.get("residual")
    if residual is not None:
        _, aside = used_rows(arrays, len(residual))
        if aside.sum() == len(numbers):
            size = np.linalg.norm(residual[aside, :3], axis=-1)
            scale, unit = display_unit("m", float(np.median(size)) or 1.0)
            columns.append(f"residual [{unit}]")
            for row, value in zip(cells, size, strict=True):
                row.append(number_text(float(value) / scale, 4) if np.isfinite(value) else "not within reach")
    reasons = results.get("why_set_aside", [])
    if len(reasons) == len(numbers):
        columns.append("why")
        for row, reason in zip(cells, reasons, strict=True):
            row.append(reason)
    note = f"They are evidence neither for nor against any effect and count in no figure above. {note}"
    return Table("Which rows were set aside?", tuple(columns), [tuple(cell) for cell in cells], note, ("why",))
