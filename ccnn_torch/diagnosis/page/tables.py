"""The tables of a diagnosis: how large the gap is, which effects, what is like what, where, what to measure next."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.diagnosis.page.data import NEXT, About, gaps_of, used_rows
from ccnn_torch.diagnosis.verdict.text import (
    block_text,
    effect_words,
    floor_words,
    listed,
    network_text,
    probability_words,
    words_for,
)
from ccnn_torch.display import display_unit, number_text, unit_text
from ccnn_torch.files.write import write_rows
from ccnn_torch.report.table import Table

Block = Mapping[str, Any]
_REMOVED = (
    "Removed: share of the mean square above the noise that goes on data not used for fitting; it is unknown (–) where "
    "the gap is not above the noise."
)


def percent(value: float | None, interval: Sequence[float] | None = None) -> str:
    """A share as `93.0 [91.0, 95.0]`, without its unit."""
    if value is None:
        return "–"
    text = f"{100 * value:.1f}"
    if interval is not None:
        text += f" [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"
    return text


def percent_interval(interval: Sequence[float] | None) -> str:
    """`91.0 to 95.0`, without its unit."""
    return "–" if interval is None else f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"


def gap_table(results: Block, about: About) -> Table:
    """The gap before and after against the noise floor, of position and of rotation."""
    rows = []
    for name, block in gaps_of(results):
        scale, unit = display_unit(block["unit"], block["before"] or 1.0)
        sizes = (number_text(_over(block[part], scale), 4) for part in ("before", "after", "noise_floor"))
        ratio = block["before"] / block["noise_floor"] if block["noise_floor"] and block["before"] is not None else None
        rows.append((f"{name} [{unit}]", *sizes, number_text(ratio, 3), percent(block["reducible_share"])))
    columns = ("gap", "before", "after", floor_words(results), "before / noise [1]", "above the noise [%]")
    of = words_for(results).place
    note = (
        f"RMS over the data not used for fitting of the distance between measured and modelled {of}; after: with the "
        "effects of the verdict in the model; above the noise: share of the mean square that a better model could "
        "remove."
    )
    return Table("How large is the gap?", columns, rows, f"{note} {about.noise}".rstrip())


def effect_table(results: Block, *, least: float = 0.0) -> Table | None:
    """Every candidate, most probable first: its probability, and the gap with it alone in the model.

    Args:
        least: probability below which a candidate that is not in the verdict is left out.
    """
    chosen = set(results["verdict"]["effects"])
    shown = [e for e in results["effects"] if e["name"] in chosen or e["probability"] >= least]
    if not shown:
        return None
    scale, unit = display_unit(results["gap"]["unit"], results["gap"]["before"] or 1.0)
    rows = [
        (
            e["name"] + " ●" * (e["name"] in chosen),
            effect_words(e["name"]),
            probability_words(e["probability"]),
            number_text(_over(e["gap_after"], scale), 4),
            percent(e["shrink"], e["shrink_ci95"]),
            listed(e["indistinguishable_from"], "or") if e["indistinguishable_from"] else "–",
        )
        for e in shown
    ]
    alone = f"gap with it alone [{unit}]"
    columns = (
        "effect",
        "what it is",
        "probability",
        alone,
        "removed [%]",
        "indistinguishable from",
    )
    before = number_text(_over(results["gap"]["before"], scale), 4)
    note = (
        f"● in the verdict. The gap without any of them is {before} {unit}. {_REMOVED} In brackets: 95 % interval. "
        "Probability: of each name among those tried; the verdict claims less where something could replace it or "
        "speaks against it."
    )
    if hidden := len(results["effects"]) - len(shown):
        note += f" Not shown: {hidden} with a probability below {least:g}."
    words = ("what it is", "indistinguishable from")
    return Table("Which effect?", columns, rows, note, words, details=("what it is", alone))


def order_table(results: Block) -> Table | None:
    """The verdict's effects added to the model one after the other, all of them on blocks of rows, and what a network
    would still gain."""
    added, network = results.get("in_order") or [], results.get("network") or {}
    if not added and network.get("gap_after") is None:
        return None
    gap = results["gap"]
    scale, unit = display_unit(gap["unit"], gap["before"] or 1.0)
    rows = [("the model as it is", number_text(_over(gap["before"], scale), 4), "–", "–")]
    for entry in added:
        size = number_text(_over(entry["gap_after"], scale), 4)
        rows.append((f"+ {entry['name']}", size, percent(entry["shrink"]), percent_interval(entry["shrink_ci95"])))
    far = results.get("by_block")
    if far is not None:
        size = number_text(_over(far["after"], scale), 4)
        rows.append(("all of them, by block", size, percent(far["shrink"]), percent_interval(far["shrink_ci95"])))
    if network.get("gap_after") is not None:
        rows.append(("+ a network on the remainder", number_text(network["gap_after"] / scale, 4), "–", "–"))
    rows.append((floor_words(results), number_text(_over(gap["noise_floor"], scale), 4), "–", "–"))
    columns = ("added to the model", f"gap on held-out rows [{unit}]", "removed in all [%]", "95 % interval [%]")
    notes = (_REMOVED, block_text(results), network_text(results))
    return Table("How far does it shrink?", columns, rows, " ".join(n for n in notes if n))


def confusable_table(results: Block) -> Table | None:
    """Pairs of effects that these data do not distinguish, why, and which measurement would."""
    odds = {e["name"]: e["probability"] for e in results["effects"]}
    rows, listed = [], set()
    for effect in results["effects"]:
        for other in effect["indistinguishable_from"]:
            pair = frozenset((effect["name"], other))
            if pair in listed:
                continue
            listed.add(pair)
            apart = effect.get("signatures", {}).get(other)
            number = next(
                (i for i, m in enumerate(results["next_measurements"], 1) if pair <= set(m["separates"])), None
            )
            rows.append(
                (
                    f"{effect['name']} or {other}",
                    f"{probability_words(effect['probability'])} or {probability_words(odds.get(other, 0.0))}",
                    "–" if apart is None else f"{math.degrees(apart['angle']):.1f}",
                    "–" if apart is None else number_text(apart["separation"], 2),
                    "–" if number is None else f"number {number}",
                )
            )
    if not rows:
        return None
    note = (
        "On these rows the second can leave nearly the same trace as the first, so the numbers cannot say which it is. "
        "Angle: between what the first does to these rows and all that the second can do, 0 = the same, 90 = unlike; "
        "difference: what the second cannot copy over all rows together, in units of the noise: below about 3 it is "
        "hidden. Separated by: the first of the next measurements that does."
    )
    columns = ("pair", "probability", "angle [°]", "difference / noise [1]", "separated by")
    return Table("Which effects do these rows not distinguish?", columns, rows, note, ("separated by",), page_only=True)


def unseen_table(results: Block) -> Table | None:
    """Effects that these records cannot show, and why."""
    unseen = results.get("not_seen")
    if not unseen:
        return None
    rows = tuple((name, f"needs {why}") for name, why in unseen.items())
    return Table("What can these records not show?", ("effect", "why"), rows, "", ("why",))


def record_table(results: Block) -> Table | None:
    """Which columns to add to the records, most promising first."""
    missing = [entry for entry in results.get("missing_covariates", ()) if not entry.get("constant")]
    if not missing:
        return None
    typical = max(size for entry in missing for size in entry["effects"].values())
    scale, unit = display_unit(missing[0]["unit"], typical)
    rows = tuple(
        (columns_text(entry["columns"]), name, number_text(size / scale, 3))
        for entry in missing
        for name, size in entry["effects"].items()
    )
    note = (
        "Size: median error that an effect of plausible size makes at these poses. Without the column the effect can "
        "make that part of the gap and not be named."
    )
    columns = ("column", "would show", f"size [{unit}]")
    return Table("What should be recorded as well?", columns, rows, note, ("would show",))


def columns_text(columns: Sequence[str]) -> str:
    """Columns of records, `direction1[1] … direction6[1]` for many of a kind."""
    return ", ".join(columns) if len(columns) < 4 else f"{columns[0]} … {columns[-1]}"


def _over(value: float | None, scale: float) -> float | None:
    return None if value is None else value / scale


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
    return Table("In which region?", columns, rows, "Largest share first. " + _share_note(results), page_only=True)


def next_table(results: Block, about: About) -> Table | None:
    """What to measure next, most informative first: a row each, or a column each where it has many values."""
    wanted = results["next_measurements"]
    if not wanted:
        return None
    if "motion" in wanted[0]:
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
    rows = [tuple(cell) for cell in cells]
    return Table("Which rows were set aside?", tuple(columns), rows, note, ("why",), page_only=True)
