"""What a technician needs first: what is wrong, how sure that is, what it removes, and what to do now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ccnn_torch.diagnosis.page.data import NEXT, About
from ccnn_torch.diagnosis.page.numbers import numbers_table
from ccnn_torch.diagnosis.page.place_words import where_words
from ccnn_torch.diagnosis.page.tables import columns_text
from ccnn_torch.diagnosis.verdict.findings import findings
from ccnn_torch.diagnosis.verdict.text import (
    capital,
    follows_words,
    in_doubt,
    listed,
    no_effect_words,
    probability_words,
    size_text,
    undetermined,
)
from ccnn_torch.effects import OUTLIER
from ccnn_torch.report.page import Answer

Block = Mapping[str, Any]
# Numbers of all effects on a screen; a page has room for more.
ON_SCREEN, ON_PAGE = 6, 16


def first_screen(results: Block, about: About, most: int = ON_PAGE) -> list[Answer]:
    """The answers in reading order.

    Args:
        results: as in `diagnosis.json`.
        about: with the folder and the command of a compensator, where they are known.
        most: about so many numbers to enter are given.
    """
    said = [Answer("What is wrong", _wrong(results))]
    if where := where_words(results, about):
        said.append(Answer("Where", f"{capital('; '.join(where))}."))
    said.append(Answer("How sure", _sure(results)))
    if removed := _removed(results):
        said.append(Answer("What it removes", removed))
    if look := " ".join(f.look for f in findings(results)):
        said.append(Answer("Look at", look, table=numbers_table(results, most)))
    if about.compensate:
        said.append(Answer("Compensate", about.compensate[0], tuple(about.compensate[1:])))
    if measure := _measure(results, about):
        said.append(Answer("Measure next", measure))
    return said


def _wrong(results: Block) -> str:
    verdict, open_ = results["verdict"], undetermined(results)
    found = [f.text for f in findings(results)]
    if verdict["none"]:
        if open_:
            return f"{capital(open_)}; the likeliest: nothing beyond the noise."
        if results.get("motion") and verdict["probability"] <= 0.5:
            return "Nothing that these logs determine."
        if results.get("motion") and in_doubt(results):
            return "Nothing beyond what is taken for noise."
        return "Nothing: model and machine differ by no more than the noise."
    if verdict["outside_library"] or not found:
        rest = "a rest" if found else "an error"
        found.append(f"{rest} that {follows_words(verdict)}, which {no_effect_words(results)} describes")
    likeliest = f"{capital(open_)}; the likeliest: " if open_ else ""
    return likeliest + " ".join(f"{capital(text)}." for text in found)


def _sure(results: Block) -> str:
    verdict = results["verdict"]
    text = f"Probability {probability_words(verdict['probability'])}"
    if in_doubt(results):
        text += "; the noise is not known, and what is taken for it may hold another cause"
    return f"{text}."


def _removed(results: Block) -> str:
    """The gap before and after: on rows at random, and where nothing was measured."""
    verdict, gap, far = results["verdict"], results["gap"], results.get("by_block")
    if not verdict["effects"] or verdict["effects"] == [OUTLIER] or gap["before"] is None or gap["after"] is None:
        return ""
    rows = "runs not used for fitting" if results.get("motion") else "rows at random"
    text = f"{size_text(gap['before'], gap)} → {size_text(gap['after'], gap)} on {rows}"
    if results.get("motion"):
        pass
    elif far is not None:
        before, after = (size_text(far[key], far) for key in ("before", "after"))
        text += f", {before} → {after} where nothing was measured (by block)"
    else:
        text += "; not known where nothing was measured"
    known = "estimated at" if results.get("noise") == "estimated" else "is"
    floor = f"; the noise {known} {size_text(gap['noise_floor'], gap)}" if gap["noise_floor"] else ""
    network = results.get("network") or {}
    if network.get("gap_after") is not None and network["gain_ci95"][0] > 0:
        floor += f"; with a network on the rest {size_text(network['gap_after'], network)}"
    return f"{text}{floor}."


def _measure(results: Block, about: About) -> str:
    """The next measurements, and the columns to record as well."""
    said = []
    wanted = results["next_measurements"]
    if wanted:
        rivals = list(dict.fromkeys(name for entry in wanted for name in entry["separates"]))
        alone = "to sharpen the numbers" if results["verdict"]["effects"] else "to see smaller effects"
        aim = f"to tell {listed(rivals, 'from')} apart" if rivals else alone
        aim = f"to see whether {rivals[0]} acts" if len(rivals) == 1 else aim
        path = f"{about.folder}/{NEXT}" if about.folder else NEXT
        motion = wanted[0].get("motion")
        what = f"{len(wanted)} poses" if motion is None else f"{motion['joint']}: {motion['text']},"
        said.append(f"{what} {aim}: {path}.")
    missing = results.get("missing_covariates")
    if missing:
        each = [f"{columns_text(entry['columns'])} (would show {listed(list(entry['effects']))})" for entry in missing]
        said.append(f"Record as well: {listed(each)}.")
    return " ".join(said)
