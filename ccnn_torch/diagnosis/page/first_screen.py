"""What a technician needs first: what is wrong, where, how sure that is, what it removes, and what to do now."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ccnn_torch.diagnosis.page.data import NEXT, About
from ccnn_torch.diagnosis.page.tables import columns_text, regime_words, row_parts
from ccnn_torch.diagnosis.verdict.findings import (
    clear_parameters,
    findings,
    frequency_words,
    places,
    repeats_of,
    told_words,
)
from ccnn_torch.diagnosis.verdict.text import (
    LEAST,
    both_sides,
    capital,
    follows_words,
    in_doubt,
    listed,
    no_effect_words,
    others_words,
    probability_words,
    size_text,
    undetermined,
    words_for,
)
from ccnn_torch.display import count_text, number_text, to_enter, unit_text
from ccnn_torch.effects import OUTLIER
from ccnn_torch.effects.words import words_of
from ccnn_torch.report.page import Answer, Card
from ccnn_torch.report.table import Table

Block = Mapping[str, Any]
# Numbers of all effects on a screen; a page has room for more.
ON_SCREEN, ON_PAGE = 6, 16


def first_screen(results: Block, about: About, most: int = ON_PAGE) -> list[Answer]:
    """The answers in reading order: what is wrong, what that removes and what to enter, then the rest.

    Args:
        results: as in `diagnosis.json`.
        about: with the folder and the command of a compensator, where they are known.
        most: about so many numbers to enter are in the table; the lines have three.
    """
    said = [Answer("What is wrong", _wrong(results)), Answer("How sure", _sure(results), table=joints_table(results))]
    if removed := _removed(results):
        said.append(Answer("What it removes", removed))
    if (table := numbers_table(results, most)) is not None:
        said.append(_enter(results, table, about))
    if about.compensate:
        said.append(Answer("Compensate", about.compensate[0], tuple(about.compensate[1:])))
    if where := where_words(results, about):
        said.append(Answer("Where", f"{capital('; '.join(where))}."))
    if look := " ".join(f.look for f in findings(results)):
        said.append(Answer("Look at", look))
    if results.get("frames"):
        said.append(Answer("Fitted frames", _frames(results["frames"])))
    if measure := _measure(results, about):
        said.append(Answer("Measure next", measure))
    return said


def cards(results: Block) -> list[Card]:
    """A card for each finding, with the clearest numbers of it; none where nothing is wrong."""
    found, verdict = [], results["verdict"]
    for finding in findings(results):
        rows = _number_rows(results, finding.effect, _ON_A_CARD)[0]
        lines = tuple(_line(row) for row in rows)
        found.append(Card(capital(words_of(finding.effect).short), f"{capital(finding.text)}.", lines, finding.look))
    if verdict["outside_library"] and not verdict["none"]:
        text = f"A rest that {follows_words(verdict)}, which {no_effect_words(results)} describes."
        found.append(Card("What is left", text))
    return found


def _enter(results: Block, table: Table, about: About) -> Answer:
    """The clearest numbers, a line each; the table has more of them."""
    known = [_number_rows(results, effect, _ON_LINES) for effect in results["verdict"]["effects"]]
    rows, count = [row for own, *_ in known for row in own], sum(len(own) + more for own, _, more in known)
    enters = [row for row in rows if row[3] != "–"]
    shown, kept = enters or rows, f"{about.folder}/" if about.folder else ""
    if len(shown) > ON_SCREEN:
        shown = shown[:_ON_LINES]
        text = f"{len(shown)} of {count} numbers, ± at 95 %; only all together repair the model: {kept}report.html."
    else:
        more, rest = "if nothing else acts", count - len(shown)
        if rest > 0:
            more = f"{rest} more {'is' if rest == 1 else 'are'} in {kept}report.html"
        text = f"{'all of these together, ' * (len(enters) > 1)}± at 95 %; {more}."
    return Answer("Enter instead" if enters else "Numbers found", text, tuple(_line(row) for row in shown), table)


def _line(row: Sequence[str]) -> str:
    name, value, interval, enter = row
    return f"{name}: {value} {interval}" if enter == "–" else f"{name}: {enter} (off by {value} {interval})"


def _wrong(results: Block) -> str:
    verdict, open_ = results["verdict"], undetermined(results)
    found = [f.text for f in findings(results)]
    if len(joints := results.get("joints", [])) > 1 and verdict["effects"]:
        # Numbers, and names that the data do not distinguish, are in the table.
        each = [(one, ", ".join(words_of(e).short for e in one["effects"])) for one in joints]
        named = [(_joint(one["joint"]), one.get("word"), names) for one, names in each if names]
        found = [f"{joint} ({word}): {names}" if word else f"{joint}: {names}" for joint, word, names in named]
        return f"{capital('; '.join(found))}."
    if verdict["none"]:
        if open_:
            return f"{capital(open_)}; the likeliest: nothing beyond the noise."
        if verdict["probability"] <= 0.5:
            return f"Nothing that these {words_for(results).rows} determine."
        if in_doubt(results):
            return "Nothing beyond what is taken for noise."
        return "Nothing: model and machine differ by no more than the noise."
    if verdict["outside_library"] or not found:
        rest = "a rest" if found else "an error"
        found.append(f"{rest} that {follows_words(verdict)}, which {no_effect_words(results)} describes")
    likeliest = f"{capital(open_)}; the likeliest: " if open_ else ""
    return likeliest + " ".join(f"{capital(text)}." for text in found)


def _sure(results: Block) -> str:
    verdict = results["verdict"]
    least = f" {LEAST}" * (len(results.get("joints", ())) > 1)
    what = "that nothing acts" if verdict["none"] else others_words(results)
    what = what if verdict["effects"] or verdict["none"] else "that no effect of the library is the cause"
    text = f"Probability {probability_words(verdict['probability'])}{least} {what}"
    if in_doubt(results):
        text += "; the noise is not known, and what is taken for it may hold another cause"
    return f"{text}."


def _removed(results: Block) -> str:
    """The gap before and after: on rows at random, and where nothing was measured."""
    verdict, gap, far = results["verdict"], results["gap"], results.get("by_block")
    if not verdict["effects"] or verdict["effects"] == [OUTLIER] or gap["before"] is None or gap["after"] is None:
        return ""
    words = words_for(results)
    text = f"{size_text(gap['before'], gap)} → {size_text(gap['after'], gap)} on {words.unseen}"
    if far is not None:
        before, after = (size_text(far[key], far) for key in ("before", "after"))
        text += f", {before} → {after} where nothing was measured (by block)"
    else:
        text += words.elsewhere
    known = "estimated at" if results.get("noise") == "estimated" else "is"
    floor = f"; the noise {known} {size_text(gap['noise_floor'], gap)}" if gap["noise_floor"] else ""
    network = results.get("network") or {}
    if network.get("gap_after") is not None and network["gain_ci95"][0] > 0:
        floor += f"; with a network on the rest {size_text(network['gap_after'], network)}"
    return f"{text}{floor}."


def _frames(frames: Mapping[str, Any]) -> str:
    """What was fitted before anything was named, and what it may hide."""
    told = []
    for name, (x, y, z, *turn) in frames.items():
        shift = ", ".join(f"{1e3 * v:.2f}" for v in (x, y, z))
        told.append(f"{name} ({shift}) mm and {math.degrees(math.hypot(*turn)):.3f}° from the model's")
    hidden = " or ".join({"base": "the first link's place", "tool": "the flange"}[name] for name in frames)
    return f"{capital('; '.join(told))}. An error of {hidden} is in these, and in no number above."


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
        what = count_text(len(wanted), "pose") if motion is None else f"{motion['joint']}: {motion['text']},"
        said.append(f"{what} {aim}: {path}.")
    for still, what in ((False, "Record as well"), (True, "Recorded, but never changing")):
        each = [
            f"{columns_text(entry['columns'])} (would show {listed(list(entry['effects']))})"
            for entry in results.get("missing_covariates", ())
            if entry.get("constant", False) == still
        ]
        text = listed(each)
        said += [f"{what}: {text}{both_sides(text) if still else ''}."] if each else []
    return " ".join(said)


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


_Z95 = 1.96
# Of the middle from which a gain counts: a gain of some thousandths times the rest is no error.
_MIDDLE_DIGITS = 6
# Numbers of an effect, however many effects there are; lines of the first screen; and numbers of a card.
_FEWEST, _ON_LINES, _ON_A_CARD = 2, 3, 4
# A wave of forty periods over the travel, ten travels from where the joint counts from, is in step to a thousandth.
_PERIOD_DIGITS = 7
_OWN_UNIT = "A number without unit has that of the simulator."


def numbers_table(results: Block, most: int) -> Table | None:
    """The largest numbers with their 95 % intervals; of parameters of the model also what to enter in their place.

    Args:
        results: as in `diagnosis.json`.
        most: about so many are shown, of each effect those that are largest against their standard deviations.
    """
    rows, notes, left_out = [], [], 0
    chosen = results["verdict"]["effects"]
    for effect in chosen:
        own, remarks, more = _number_rows(results, effect, most // max(len(chosen), 1))
        rows += own if len(chosen) == 1 else [(f"{words_of(effect).short}, {row[0]}", *row[1:]) for row in own]
        notes += remarks
        left_out += more
    if not rows:
        return None
    columns: tuple[str, ...] = ("number", "error found", "± (95 %)", "enter instead")
    cells: list[tuple[str, ...]] = [*rows]
    if all(row[3] == "–" for row in rows):
        columns, cells = columns[:3], [row[:3] for row in rows]
    if left_out:
        notes.append(f"{left_out} more that are clearly not 0 are in diagnosis.json.")
    notes.append("The intervals hold if nothing else acts and the rest of the model is right.")
    return Table("Numbers to enter", columns, cells, " ".join(notes))


def _number_rows(results: Block, effect: str, most: int) -> tuple[list[tuple[str, str, str, str]], list[str], int]:
    """Of one effect its clearest numbers (name, error, half its interval, what to enter), notes, and how many are left.

    Those that have to be entered together are all there, where these are not too many.
    """
    parameters = {e["name"]: e for e in results["effects"]}.get(effect, {}).get("parameters", {})
    clear = clear_parameters(parameters)
    needed = max((block.get("together", 1) for block in clear.values()), default=0)
    repairs = needed <= min(ON_PAGE, len(clear))
    each = max(most, _FEWEST, needed if repairs else 0)
    notes = [] if repairs else ["What is shown does not repair the model: enter all numbers together."]
    rows = []
    for name in list(clear)[:each]:
        block = parameters[name]
        value, error = block["value"], _Z95 * block["sd"]
        part = block.get("part") or ""
        enter = "–" if block.get("nominal") is None or not repairs else to_enter(block, block["nominal"] + value)
        word = block.get("word") or _named(name, part)
        # A machine's file may have one number for what each leg has of its own.
        word += f", {part}" * (word in [b.get("word") for n, b in clear.items() if n != name])
        text = f"{word}{_often(name, parameters)}{_counted(block)}"
        rows.append((text, told_words(block, value, 4), f"± {told_words(block, error, 2, value)}", enter))
    notes += [_OWN_UNIT] if any(not block["unit"] for block in clear.values()) else []
    notes += [words_of(effect).meaning] if clear and words_of(effect).meaning else []
    return rows, notes, max(len(clear) - each, 0)


def joints_table(results: Block) -> Table | None:
    """The verdict on each joint of a motion; None where there is one joint alone."""
    joints, by_name = results.get("joints", []), {e["name"]: e for e in results["effects"]}
    if len(joints) < 2:
        return None
    rows = []
    for own in joints:
        name, said, rest = own["joint"], [], []
        for effect in own["effects"]:
            numbers = by_name[effect]["parameters"]
            said += [
                told_words(b, b["value"]) for n, b in clear_parameters(numbers).items() if n.startswith(f"{name} ")
            ]
            rest += [f"or {words_of(other).short}" for other in own["classes"].get(effect, ())]
        what = ", ".join(words_of(effect).short for effect in own["effects"])
        follows = follows_words(own | {"drivers": []}) if own["driver"] else ""
        if follows and what:
            rest.append(f"a rest {follows}")
        what = what or (f"what {follows} and has no name" if follows else "–")
        removed = " → ".join(size_text(own[key], results["gap"]) for key in ("gap_before", "gap_after"))
        sure = probability_words(own["probability"])
        name = f"{name} {own.get('word', '')}".strip()
        rows.append((name, what, ", ".join(said) or "–", sure, removed, "; ".join(rest) or "–"))
    columns = ("joint", "what is wrong", "number", "how sure", "gap", "or, and what is left")
    note = "Probability of each joint's names, indistinguishable ones taken as one; gaps are of runs held out."
    return Table("Each joint", columns, rows, note)


def _named(name: str, part: str) -> str:
    """A number as results call it, after the joint, leg or link that it belongs to."""
    own = name.removeprefix(f"q{part.partition(' ')[2]} ") if part else name
    return part if own in (part, f"q{part.partition(' ')[2]}") else f"{part} {own}".strip()


def _often(name: str, parameters: Block) -> str:
    """How often a wave of a periodic error repeats; empty for other numbers."""
    joint, *rest = name.split(" ")
    own = repeats_of(parameters, joint)
    if own is None or not rest:
        return ""
    times = int(rest[1]) if len(rest) > 1 and rest[1].isdigit() else 1
    return f", {frequency_words(times * own['value'], own['unit'], _PERIOD_DIGITS)}"


def _counted(block: Block) -> str:
    """From where a gain counts, and which way a number does, where that is not the usual one."""
    if "sense" in block:
        return f", {block['sense']}"
    if "about" not in block:
        return ""
    about = block["about"]
    scale, unit = (1e-3, "mm") if about["unit"] == "m" else (1.0, unit_text(about["unit"]))
    return f", about {about['joint']} = {number_text(about['value'] / scale, _MIDDLE_DIGITS)} {unit}"
