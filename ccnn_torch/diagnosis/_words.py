"""The verdict in plain English."""

from __future__ import annotations

from collections.abc import Sequence

from ccnn_torch.diagnosis._report import amount
from ccnn_torch.diagnosis._shrink import Gap
from ccnn_torch.diagnosis._verdict import Judgement

__all__ = ["joined", "sentence"]


def joined(names: Sequence[str], word: str = "and") -> str:
    """`a`, `a and b`, `a, b and c`."""
    return ", ".join(names[:-1]) + f" {word} {names[-1]}" if len(names) > 1 else "".join(names)


def sentence(judgement: Judgement, gap: Gap, unit: str, aside: int, outlier: bool) -> str:
    """Two or three sentences: how large the gap is, what makes it, how far it shrinks."""
    told = [_size(gap, unit, judgement)]
    if outlier:
        told.append(f"Nothing but {aside} bad rows was found; they are set aside.")
        return " ".join(told)
    if judgement.outside:
        where = f", which follows {_driver(judgement.driver)}" if judgement.driver else ""
        known = f" beside {joined(judgement.names)}" if judgement.names else ""
        told.append(f"Something that no effect of the library describes is at work{known}{where}.")
    elif judgement.names:
        told.append(f"{joined([_named(judgement, n) for n in judgement.names]).capitalize()} explains it.")
    if judgement.names and gap.shrink is not None and gap.interval is not None:
        low, high = (round(100 * v) for v in gap.interval)
        told.append(
            f"With it in the model the gap shrinks by {round(100 * gap.shrink)} % on rows that the fit has not seen "
            f"(95 % interval {low} to {high} %), to {amount(gap.after, unit)}."
        )
    if judgement.names or judgement.outside:
        told.append(f"Probability of this answer: {judgement.probability:.2f}.")
    if aside:
        told.append(f"{aside} {'row was' if aside == 1 else 'rows were'} set aside.")
    return " ".join(told)


def _size(gap: Gap, unit: str, judgement: Judgement) -> str:
    if not judgement.names and not judgement.outside:
        return f"The gap of {amount(gap.before, unit)} is no more than the noise ({amount(gap.floor, unit)})."
    return f"The gap is {amount(gap.before, unit)} against a noise of {amount(gap.floor, unit)}."


def _named(judgement: Judgement, name: str) -> str:
    others = judgement.classes.get(name, ())
    return f"{name} (these rows cannot tell it from {joined(others, 'or')})" if others else name


def _driver(driver: str | None) -> str:
    return {"workspace": "the place in the workspace", "time": "the time", "temperature": "the temperature"}.get(
        driver or "", f"{driver}"
    )
