"""The verdict in two sentences, from the numbers of `diagnosis.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ccnn_torch.coordinates import Condition
from ccnn_torch.diagnosis.residual.correlation import Correlation
from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.effects.words import words_of
from ccnn_torch.records.table import name_lines

Block = Mapping[str, Any]

SURE = 0.95
"""From this probability on a verdict is said as a fact, below it as the likeliest explanation."""

LEAST = "at the least sure joint"
"""Of several joints the least probable verdict is that of the whole."""
# From this probability on an effect is likely, whatever the verdict names.
_LIKELY = 0.5
# Of the noise, from which what is left may be another cause.
_MUCH_LEFT = 2.0
# Below this probability the rows determine no verdict: it is but the likeliest of many.
_OPEN = 0.05
# What is left beyond so many steps of an encoder is not its noise.
_STEPS = 3.0
# Up to so many effects without support are named one by one.
_FEW_TRIED = 3
_DRIVERS = {
    "workspace": "the position in the workspace",
    "temperature": "the temperature",
    "time": "the time",
    # Of a machine in motion.
    "speed": "the speed",
    "acceleration": "the acceleration",
    "reversal": "the reversals of the motion",
    "position": "the position of the joint",
    "torque": "the torque of the motor",
}


class Words(NamedTuple):
    """What is said otherwise of poses than of a motion.

    Attributes:
        rows, place: what a verdict rests on, and what is measured of each.
        gap: what a gap is of, by its unit.
        unseen: on what it was judged.
        elsewhere: what is said where nothing is known of rows far from all others.
    """

    rows: str
    place: str
    gap: Mapping[str, str]
    unseen: str
    elsewhere: str


_OF_POSES = Words(
    "rows", "pose", {"m": "position", "rad": "rotation"}, "rows at random", "; not known where nothing was measured"
)
_OF_A_MOTION = Words("logs", "position", dict.fromkeys(("m", "rad"), "joint position"), "runs not used for fitting", "")


def words_for(results: Block) -> Words:
    """The words of a diagnosis of poses, or of a motion."""
    return _OF_A_MOTION if results.get("motion") else _OF_POSES


def effect_words(name: str) -> str:
    """What an effect of the library is called in a sentence; a user's own effect by its name."""
    return words_of(name).cause


_NOISE_FROM = {
    "columns": " (from the columns of standard deviations)",
    "repeats": " (from repeated readings of one target)",
}


def driver_words(driver: str | None) -> str:
    """What `verdict.driver` is called in a sentence.

    Args:
        driver: `workspace`, `joint qN`, `load NAME`, `temperature` or `temperature NAME`, `direction N`, `time`, or
            None where none is known.
    """
    if driver is None:
        return "nothing that was recorded"
    kind, _, name = driver.partition(" ")
    load = f"the load along {name}" if name in ("x", "y", "z") else f"the load's moment {name}"
    way = f"the direction of {'joint ' * name.isdigit()}{name}"
    named = {"joint": f"joint {name}", "load": load, "direction": way}
    named["temperature"] = f"the temperature {name}"
    return _DRIVERS.get(driver) or (named.get(kind) if name else None) or driver


def follows_words(verdict: Block) -> str:
    """What a residual outside the library follows."""
    # Files of earlier versions name one driver.
    drivers = verdict.get("drivers") or [verdict["driver"]] * bool(verdict["driver"])
    return f"follows {listed([driver_words(d) for d in drivers])}" if drivers else "has no known driver"


def probability_words(probability: float) -> str:
    """A probability to two digits that is never said to be 0 or 1."""
    if probability > 0.99:
        return "above 0.99"
    return "below 0.01" if probability < 0.01 else f"{probability:.2f}"


def gap_words(results: Block) -> str:
    """The first sentence: how large the gap is, and how large against the noise."""
    blocks = _blocks(results)
    if not blocks:
        return "There is no gap between model and machine on the data not used for fitting."
    gaps = " and ".join(size_text(block["before"], block) for block in blocks)
    times = [_times(block["before"] / block["noise_floor"]) for block in blocks if block["noise_floor"]]
    if len(times) < len(blocks):
        return f"The gap is {gaps}; how large the noise is, is not known."
    many = " and ".join(times)
    if results.get("noise", "given") == "estimated":
        left = " and ".join(size_text(block["noise_floor"], block) for block in blocks)
        known = ", and how much of that is noise is not known" if in_doubt(results) else ""
        return f"The gap is {gaps}; the best explanation leaves {left}{known}."
    return f"The gap of {gaps} is {many} times the noise{_NOISE_FROM.get(results.get('noise', 'given'), '')}."


def in_doubt(results: Block) -> bool:
    """Whether what is taken for noise may hold another cause; of a motion not where it is the encoder's step."""
    gap, step = results["gap"], results.get("encoder_step")
    left = gap["before"] if gap["after"] is None else gap["after"]
    return results.get("noise") == "estimated" and not (step and left is not None and left <= _STEPS * step)


def others_words(results: Block) -> str:
    """Whether anything acts beside what the verdict names: effects that are likelier than not, with probabilities."""
    named, every = results["verdict"]["effects"], {e["name"]: e for e in results["effects"]}
    told = {*named, *(other for name in named if name in every for other in every[name]["indistinguishable_from"])}
    likely = [e for name, e in every.items() if name not in told and e["probability"] >= _LIKELY]
    likely.sort(key=lambda e: -e["probability"])
    each = listed([f"{words_of(e['name']).short} ({probability_words(e['probability'])})" for e in likely])
    if likely:
        return f"that these causes act; likely beside them: {each}"
    gap = results["gap"]
    times = (gap["after"] or 0.0) / gap["noise_floor"] if gap["noise_floor"] else 0.0
    if times < _MUCH_LEFT or in_doubt(results):
        return "that these causes, and no others, act"
    rest = "errors of their forms, or further causes of that size"
    return f"that these causes act; they leave {_times(times)} times the noise: {rest}"


def undetermined(results: Block) -> str:
    """That the rows do not determine the verdict, without a full stop; empty where they do."""
    open_ = results["verdict"]["probability"] < _OPEN
    return f"the {words_for(results).rows} do not determine the cause" if open_ else ""


def verdict_text(results: Block) -> str:
    """Two sentences that an engineer understands without knowing the method: how large the gap is, and what causes it.

    One more for each caution.

    Args:
        results: as in `diagnosis.json`; of `verdict` all but `text` is read.
    """
    verdict = results["verdict"]
    said = [gap_words(results)]
    if open_ := undetermined(results):
        said.append(f"{capital(open_)}.")
    if verdict["none"]:
        none = "The likeliest is none beyond the noise" if open_ else "No cause beyond the noise is to be seen"
        said.append(f"{none} ({_probability(results)}).")
    else:
        said.append(_cause(results))
    doubts = (f"{'And' if i else 'But'} {caution}." for i, caution in enumerate(results.get("cautions", ())))
    return " ".join([*said, *doubts])


def unseen_text(name: str, why: str) -> str:
    """That the records cannot show an effect, without a full stop."""
    return f"{name} cannot be seen without {why}"


def both_sides(columns: str) -> str:
    """The end of a sentence on columns that never change: what to do where they are directions; else empty."""
    return ": approach the joints from both sides" if "direction" in columns else ""


def lacking_text(name: str, condition: Condition) -> str:
    """That a simulator takes what the records do not have, without a full stop."""
    usual = f"{condition.usual:g} {condition.unit}"
    return f"{name} takes {condition.name}, which the records do not have: it was simulated with {usual}"


def shared_text(correlation: Correlation) -> str:
    """What noise the rows share, without a full stop."""
    value = number_text(correlation.value, 2)
    if correlation.target is None and correlation.alone:
        share = f"{100 * (1 - correlation.alone):.0f} %"
        return f"about {share} of the noise's variance drifts slowly from row to row, allowed for"
    if correlation.target is None:
        return f"the noise of a row has a correlation of about {value} with that of the row before, allowed for"
    targets = int(correlation.target.max()) + 1
    return (
        f"readings of one target share about {100 * correlation.value:.0f} % of the noise's variance, allowed for: "
        f"{len(correlation.target)} rows of {targets} targets"
    )


def aside_text(rows: Sequence[int], why: Sequence[str], lines: Sequence[int] = ()) -> str:
    """Which rows were set aside and why, the first few of each reason; empty where none was.

    Args:
        rows: their numbers, from 0.
        why: the reason for each of them.
        lines: of each of them in the file; () where there is no file: they are then called by their number from 1.
    """
    if not rows:
        return ""
    parts = []
    for reason in dict.fromkeys(why):
        those = [i for i, one in enumerate(why) if one == reason]
        if lines:
            # By row, as `name_lines` takes them.
            by_row = np.zeros(max(rows) + 1, dtype=np.int64)
            by_row[list(rows)] = lines
            named = name_lines(by_row, [rows[i] for i in those])
        else:
            more = f" and {len(those) - 5} more" if len(those) > 5 else ""
            numbers = ", ".join(str(rows[i] + 1) for i in those[:5])
            named = f"row{'s' if len(those) > 1 else ''} {numbers} (counted from 1){more}"
        parts.append(f"{capital(reason)}: {len(those)}, at {named}.")
    return f"{count_text(len(rows), 'row')} set aside. {' '.join(parts)}"


def block_text(results: Block) -> str:
    """How far the effects go where no row was fitted, in one sentence; empty where the verdict names none."""
    far = results.get("by_block")
    if far is None:
        return ""
    before, after = (size_text(far[key], far) for key in ("before", "after"))
    return (
        f"Held out in {len(far['blocks'])} blocks along the direction in which the joints vary most, each judged by a "
        "fit to the other rows with the names and shapes of all rows, the effects take the gap from "
        f"{before} to {after}."
    )


def network_text(results: Block) -> str:
    """What a network on the remainder would still gain, in one sentence; empty where it was not asked for."""
    network = results.get("network")
    if network is None:
        return ""
    if network["gap_after"] is None:
        return f"A network has nothing left to learn: {network['reason']}."
    before, after = (size_text(network[key], network) for key in ("gap_before", "gap_after"))
    low, high = (size_text(v, network) for v in network["gain_ci95"])
    if network["gain_ci95"][0] <= 0:
        return f"A network on what is left gains nothing on rows not used for training ({before} → {after})."
    text = (
        f"A network on what is left would gain {size_text(network['gain'], network)} [{low}, {high}] more on rows not "
    )
    text += f"used for training ({before} → {after})"
    floor = results["gap"]["noise_floor"]
    if floor and network["gap_after_ci95"][1] < floor:
        text += ", less than the noise was taken for: part of that is no noise but repeats"
    return f"{text}."


def no_effect_words(results: Block) -> str:
    """What is meant by none: of the library, or of what these records can show of it."""
    return "no effect that these records can show" if results.get("not_seen") else "no effect of the library"


def _none_of(results: Block) -> str:
    """Effects that were tried without support, the first few by name."""
    tried = sorted(e["name"] for e in results["effects"])
    if len(tried) > _FEW_TRIED:
        return capital(no_effect_words(results))
    return f"None of the effects that were tried ({', '.join(tried)})" if tried else "Nothing that was tried"


def _cause(results: Block) -> str:
    verdict = results["verdict"]
    names = list(verdict["effects"])
    if names == ["outlier"]:
        rows = count_text(len(results["rows_set_aside"]), "bad row")
        return f"It comes from {rows}, set aside, and from no effect of the library ({_probability(results)})."
    if verdict["outside_library"] or not names:
        follows = follows_words(verdict)
        if not names:
            return f"{_none_of(results)} explains it: the residual {follows} ({_probability(results)})."
        verb = "explains" if len(names) == 1 else "together explain"
        text = f"{capital(listed([effect_words(n) for n in names]))} {verb} part of it{_removed(results, ', ')}; "
        return f"{text}the rest {follows}, and {no_effect_words(results)} describes it ({_probability(results)})."
    by_name = {e["name"]: e for e in results["effects"]}
    classes = {e["name"]: [n for n in e["indistinguishable_from"] if n not in names] for e in results["effects"]}
    likes = [classes.get(name, []) for name in names]
    angles = [by_name.get(name, {}).get("signatures", {}) for name in names]
    subject = listed([_with_class(n, like, a) for n, like, a in zip(names, likes, angles, strict=True)])
    sure = verdict["probability"] >= SURE
    if len(names) == 1:
        verb = "explains it" if sure else "is the likeliest explanation"
    else:
        verb = "together explain it" if sure else "together are the likeliest explanation"
    comma = "," if likes[-1] else ""
    return f"{capital(subject)}{comma} {verb} ({_probability(results)}){_removed(results, ' and would remove ')}."


def _with_class(name: str, like: Sequence[str], signatures: Block) -> str:
    """An effect with those that may replace it, and why these data do not distinguish them: the angles."""
    if not like:
        return effect_words(name)
    angles = [signatures[n]["angle"] for n in like if n in signatures]
    reason = ""
    if angles:
        widest = math.degrees(max(angles))
        size = "less than 0.1°" if widest < 0.1 else f"{'up to ' if len(angles) > 1 else ''}{widest:.1f}°"
        reason = f": on these poses their signatures are {size} apart"
    others = listed([effect_words(n) for n in like], "or")
    return f"{effect_words(name)}, or {others} (these data do not distinguish them{reason})"


def _removed(results: Block, joint: str) -> str:
    """What the verdict's effects take away, on the first of position and rotation that has a gap."""
    verdict, blocks = results["verdict"], _blocks(results)
    # An interval from nothing on tells no size; a caution replaces it.
    nothing = verdict["shrink_ci95"] is not None and verdict["shrink_ci95"][0] <= 0
    if verdict["shrink"] is None or not blocks or nothing:
        return ""
    # A digit more near the top, where 99.5 % must not be read as all of it.
    digits = 1 if verdict["shrink"] > 0.985 else 0
    text = f"{joint}{100 * verdict['shrink']:.{digits}f} %"
    if verdict["shrink_ci95"] is not None:
        low, high = (f"{100 * v:.{digits}f}" for v in verdict["shrink_ci95"])
        text += f" [{low}, {high}]"
    before, after = (size_text(blocks[0][key], blocks[0]) for key in ("before", "after"))
    if results.get("noise", "given") == "estimated":
        whole = 1 - (blocks[0]["after"] / blocks[0]["before"]) ** 2
        share = f"{joint}{100 * max(whole, 0.0):.0f} %"
        return f"{share} of its mean square on data not used for fitting ({before} → {after})"
    return f"{text} of what is above the noise on data not used for fitting ({before} → {after})"


def _blocks(results: Block) -> list[Block]:
    """Of position and rotation those that have a gap."""
    return [b for b in (results["gap"], results.get("gap_rotation")) if b and b["before"]]


def size_text(value: float, block: Block, digits: int = 3) -> str:
    """A size in the unit of a block of `diagnosis.json`, in the prefix that fits."""
    scale, unit = display_unit(block["unit"], value)
    return f"{number_text(value / scale, digits)} {unit}"


def _times(ratio: float) -> str:
    return f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.1f}" if ratio >= 0.1 else f"{ratio:.1g}"


def _probability(results: Block) -> str:
    least = f" {LEAST}" * (len(results.get("joints", ())) > 1)
    return f"probability {probability_words(results['verdict']['probability'])}{least}"


def listed(words: Sequence[str], last: str = "and") -> str:
    """`a`, `a and b`, `a, b and c`."""
    return f" {last} ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def capital(text: str) -> str:
    """The text with its first letter as a capital."""
    return text[:1].upper() + text[1:]


def floor_words(results: Block) -> str:
    """What the noise floor is called: no bound where it is but an estimate."""
    return "noise, estimated" if results.get("noise") == "estimated" else "noise floor"


def noise_text(source: str) -> str:
    """Where the standard deviation of the noise is from; source: `noise` of diagnosis.json."""
    return {
        "given": "The noise was given.",
        "columns": "The noise is that of the records' columns of standard deviations.",
        "repeats": "The noise is that of repeated readings of one target.",
    }.get(source, "The noise was estimated from the residual of the most probable set; it may hold another cause.")
