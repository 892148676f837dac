"""The tables of a diagnosis: how large the gap is, which effects, with which parameters, and what is like what."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ccnn_torch.diagnosis.page.data import About, gaps_of
from ccnn_torch.diagnosis.verdict.text import (
    block_text,
    effect_words,
    floor_words,
    listed,
    network_text,
    probability_words,
)
from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.table import Table

Block = Mapping[str, Any]
_Z95 = 1.96
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
    note = (
        "RMS over the data not used for fitting of the distance between measured and modelled pose; after: with the "
        "effects of the verdict in the model; above the noise: share of the mean square that a better model could "
        "remove."
    )
    if results.get("motion"):
        note = note.replace("pose;", "position;")
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


def parameter_table(results: Block, most: int = 24) -> Table | None:
    """The parameters of the verdict's effects with their intervals.

    Args:
        most: so many are shown, those that are largest against their standard deviations.
    """
    rows, sizes = [], []
    by_name = {e["name"]: e for e in results["effects"]}
    for effect in results["verdict"]["effects"]:
        for name, block in by_name.get(effect, {}).get("parameters", {}).items():
            value, sd = block["value"], block["sd"]
            scale, unit = display_unit(block["unit"], max(abs(value), sd or 0.0) or 1.0)
            interval = "–" if sd is None else _interval(value, sd, scale)
            numbers = (number_text(value / scale, 4), number_text(_over(sd, scale), 2), interval)
            # Of a turning joint: whole numbers a turn.
            unit = "times a turn" if name.endswith(" frequency") and block["unit"] == "1" else unit
            rows.append((f"{effect}: {name}", *numbers, unit))
            sizes.append(abs(value) / sd if sd else math.inf)
    if not rows:
        return None
    columns = ("parameter", "value", "standard deviation", "95 % interval", "unit")
    note = "Of the effects in the verdict, fitted together; the unit 1 is a number without unit."
    if (hidden := len(rows) - most) > 0:
        least = sorted(sizes, reverse=True)[most - 1]
        rows = [row for row, size in zip(rows, sizes, strict=True) if size >= least]
        note += f" The {hidden} that differ least from 0 are in diagnosis.json only."
    return Table("How large is the effect?", columns, rows, note, ("unit",))


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
    return Table("Which effects do these rows not distinguish?", columns, rows, note, ("separated by",))


def unseen_table(results: Block) -> Table | None:
    """Effects that these records cannot show, and why."""
    unseen = results.get("not_seen")
    if not unseen:
        return None
    rows = tuple((name, f"needs {why}") for name, why in unseen.items())
    return Table("What can these records not show?", ("effect", "why"), rows, "", ("why",))


def record_table(results: Block) -> Table | None:
    """Which columns to add to the records, most promising first."""
    missing = results.get("missing_covariates")
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


def _interval(value: float, sd: float, scale: float) -> str:
    low, high = (number_text((value + side * _Z95 * sd) / scale, 3) for side in (-1, 1))
    return f"{low} to {high}"
