"""Positions in the text of a program, and their numbers written in the place of those that are there."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
LEAST = {"mm": 4, "in": 6, "deg": 5, "1": 9}
"""Decimals that are written at least: a tenth of a micron, and what moves the end of a metre by less than that."""


class Point(NamedTuple):
    """A position of a program.

    Attributes:
        line: counted from 1.
        frame: `4 x 4` of x, y, z [m] and orientation, a unit matrix of rotation where there is none; None of joints.
        joints: as the controller counts them [rad or m]; None of a frame.
        left: why it cannot be changed; empty where it can.
        early: whether it stays because the machine's place is not known yet, which is nothing to look at.
    """

    line: int
    frame: Array | None = None
    joints: Array | None = None
    left: str = ""
    early: bool = False


class Edit(NamedTuple):
    """A text in the place of what stands between two places of another."""

    start: int
    end: int
    text: str


def edited(text: str, edits: Iterable[Edit]) -> str:
    """The text with all edits, which do not overlap."""
    parts, at = [], 0
    for edit in sorted(edits):
        parts += [text[at : edit.start], edit.text]
        at = edit.end
    return "".join([*parts, text[at:]])


def number_like(value: float, like: str, unit: str) -> str:
    """A number with as many decimals as another text has, or as its unit needs; the other text where it is the same."""
    decimals = max(len(re.split("[eE]", like)[0].partition(".")[2]), LEAST[unit])
    if abs(value - float(like)) < 0.5 * 10.0**-decimals:
        return like
    text = f"{value:.{decimals}f}"
    text = text.removeprefix("-") if float(text) == 0 else text
    return f"+{text}" if like.startswith("+") and not text.startswith("-") else text


def masked(text: str, hidden: str) -> str:
    """The text with blanks in the place of all that a pattern finds, line ends aside."""
    return re.sub(hidden, lambda found: re.sub(r"[^\r\n]", " ", found[0]), text)


def lines_of(text: str) -> Callable[[int], int]:
    """The line, counted from 1, of a place in the text."""
    ends = [found.start() for found in re.finditer("\n", text)]
    return lambda place: bisect_left(ends, place) + 1
