"""Positions in the text of a program, those of KRL (KUKA) and RAPID (ABB), and their numbers written anew."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ccnn_torch.display import count_text
from ccnn_torch.numerics.rotations import euler_zyx_to_matrix, matrix_to_euler_zyx, matrix_to_quaternion, nearest_euler

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


# Lines that a sentence names.
_LISTED = 5
_REAL = rf"{NUMBER}(?:[eE][-+]?\d+)?"


@dataclass
class Literal:
    """A position and where its numbers stand: x, y, z, orientation, or joints.

    Attributes:
        spans: of its numbers in the text; empty where it cannot be changed.
        units: of each.
    """

    point: Point
    spans: Sequence[tuple[int, int]] = ()
    units: Sequence[str] = ()


class Literals(ABC):
    """A program whose positions are literals.

    Attributes:
        points: in the order of the text.
    """

    def __init__(self, text: str, found: Sequence[Literal], computed: Sequence[int]) -> None:
        """computed: lines of moves to positions that are no literals of this file."""
        self._text, self._found = text, found
        self.points = [literal.point for literal in found]
        self.notes: list[str] = []
        if lines := sorted({*computed}):
            said = f"{', '.join(map(str, lines[:_LISTED]))}{' …' * (len(lines) > _LISTED)}"
            self.notes.append(
                "Without a correction of their own, as no number here says where they go (Offs, RelTool, names): "
                f"{count_text(len(lines), 'move')}, line {said}."
            )

    def written(self, changed: Sequence[Array | None]) -> tuple[str, list[Array | None]]:
        """The text with other positions, frames or joints as they are in `points`, and what then stands there.

        changed: None of those that stay.
        """
        edits, stands = [], list[Array | None]()
        for literal, value in zip(self._found, changed, strict=True):
            if value is None:
                stands.append(None)
                continue
            old = [self._text[a:b] for a, b in literal.spans]
            numbers = self._numbers(value, [float(v) for v in old], literal.point.frame is not None)
            new = [number_like(*each) for each in zip(numbers, old, literal.units, strict=True)]
            edits += [Edit(a, b, text) for (a, b), text in zip(literal.spans, new, strict=True)]
            there = [float(v) for v in new]
            stands.append(self._frame(there) if literal.point.frame is not None else np.radians(there))
        return edited(self._text, edits), stands

    def _numbers(self, value: Array, old: Sequence[float], is_frame: bool) -> list[float]:
        if not is_frame:
            return [math.degrees(v) for v in value]
        return [*(1e3 * value[:3, 3]).tolist(), *self._turn(value[:3, :3], old[3:])]

    @abstractmethod
    def _turn(self, rotation: Array, old: Sequence[float]) -> list[float]:
        """An orientation `3 x 3` as the language writes it, near the numbers that were there."""

    @staticmethod
    @abstractmethod
    def _frame(numbers: Sequence[float]) -> Array:
        """The frame `4 x 4` [m] of a position's numbers."""


class Krl(Literals):
    """KRL: frames {X .., Y .., Z .., A .., B .., C ..} [mm, deg], R = Rz(A) Ry(B) Rx(C); axes {A1 .., A2 ..} [deg].

    Frames of bases and tools are no positions.
    """

    def __init__(self, text: str) -> None:
        shown, line_of = masked(text, r'"[^"\r\n]*"|;[^\r\n]*'), lines_of(text)
        found = []
        for group in re.finditer(r"\{([^{}]*)\}", shown):
            entries = {
                entry[1].upper(): (group.start(1) + entry.start(2), group.start(1) + entry.end(2), entry[2])
                for entry in re.finditer(r"\b([A-Za-z]\w*)[ \t]+([^,]*[^,\s])", group[1])
            }
            before = shown[: group.start()].rpartition("\n")[2]
            behind = shown[group.end() : group.end() + 40].lstrip(" \t")
            if not entries.keys() & {"X", "Y", "Z", "A1"} or re.search(_NO_POSITION, before, re.IGNORECASE):
                continue
            axes = "A1" in entries
            names = [f"A{i}" for i in range(1, 7) if f"A{i}" in entries] if axes else list("XYZABC")
            line, spans = line_of(group.start()), [entries.get(name, (0, 0, ""))[:2] for name in names]
            left = ""
            if any(not re.fullmatch(_REAL, entries.get(name, (0, 0, ""))[2]) for name in names):
                left = "not all of its numbers are there"
            elif re.match(r"\s*\w*_REL\b", before, re.IGNORECASE):
                left = "a relative motion"
            elif behind.startswith(":") or re.search(_SHIFTED, before, re.IGNORECASE):
                left = "a shift of another frame"
            if left:
                found.append(Literal(Point(line, left=left)))
                continue
            values = [float(entries[name][2]) for name in names]
            point = Point(line, joints=np.radians(values)) if axes else Point(line, self._frame(values))
            found.append(Literal(point, spans, ["deg"] * len(names) if axes else ["mm"] * 3 + ["deg"] * 3))
        here = {name.upper() for name in re.findall(r"(\w+)(?:\[[^\]]*\])?\s*=\s*\{", shown)}
        moves = re.finditer(r"^[ \t]*S?(?:PTP|LIN|CIRC)[ \t]+(\w+)(?:[ \t]*,[ \t]*(\w+))?", shown, re.I | re.M)
        named = [m.start(1) for m in moves if {n.upper() for n in m.groups() if n} - here]
        super().__init__(text, found, [line_of(place) for place in named])

    def _turn(self, rotation: Array, old: Sequence[float]) -> list[float]:
        angles = matrix_to_euler_zyx(torch.from_numpy(np.array(rotation))).tolist()
        return [math.degrees(angle) for angle in nearest_euler(angles, np.radians(old).tolist())]

    @staticmethod
    def _frame(numbers: Sequence[float]) -> Array:
        return frame_of(numbers[:3], euler_zyx_to_matrix(torch.tensor(np.radians(numbers[3:]))).numpy())


# Variables of the controller, and declarations of frames, which are bases and tools.
_NO_POSITION = (
    r"(\$\w+(\[[^\]]*\])?|\w*(BASE|TOOL|MACHINE|LOAD)\w*_DATA\[[^\]]*\])\s*=\s*$|\bFRAME\b[^=]*=\s*$|\bFRAME\s*:\s*$"
)
_SHIFTED = r"(?<!\bPOS)(?<!\bE6POS)(?<!\bAXIS)(?<!\bE6AXIS):\s*$"


class Rapid(Literals):
    """RAPID: robtarget [[x,y,z],[q1..q4],[..],[..]] [mm, 1], jointtarget [[6 axes],[6 external]] [deg]."""

    def __init__(self, text: str) -> None:
        shown, line_of = masked(text, r'"[^"\r\n]*"|![^\r\n]*'), lines_of(text)
        found = []
        for group in re.finditer(rf"\[\s*{_LIST}\s*,\s*{_LIST}(\s*,\s*{_LIST}\s*,\s*{_LIST})?\s*\]", shown):
            lists = [group.span(k) for k in (1, 2)]
            spans = [
                (start + entry.start(), start + entry.end())
                for start, end in (lists if group[3] else lists[:1])
                for entry in re.finditer(r"[^,\s][^,]*?(?=\s*(?:,|$))", shown[start:end])
            ]
            texts = [shown[a:b] for a, b in spans]
            # A pose alone is of a tool or work object.
            if not group[3] and (len(texts) != 6 or group[2].count(",") != 5):
                continue
            line = line_of(group.start())
            if len(texts) != (7 if group[3] else 6) or not all(re.fullmatch(_REAL, v) for v in texts):
                found.append(Literal(Point(line, left="not all of its numbers are there")))
                continue
            values = [float(v) for v in texts]
            point = Point(line, self._frame(values)) if group[3] else Point(line, joints=np.radians(values))
            found.append(Literal(point, spans, ["mm"] * 3 + ["1"] * 4 if group[3] else ["deg"] * 6))
        shifted = re.finditer(r"\b(?:Offs|RelTool)[ \t]*\(", shown, re.IGNORECASE)
        super().__init__(text, found, [line_of(one.start()) for one in shifted])

    def _turn(self, rotation: Array, old: Sequence[float]) -> list[float]:
        quaternion = matrix_to_quaternion(torch.from_numpy(rotation.copy())).numpy()
        return [math.copysign(1.0, float(quaternion @ np.array(old))) * float(v) for v in quaternion]

    @staticmethod
    def _frame(numbers: Sequence[float]) -> Array:
        # It takes a while to load, which other programs need not wait for.
        from scipy.spatial.transform import Rotation

        # There the scalar is the last one.
        return frame_of(numbers[:3], Rotation.from_quat(np.roll(numbers[3:], -1)).as_matrix())


_LIST = r"\[([^\[\]]*)\]"


def frame_of(place: Sequence[float] | Array, rotation: Array) -> Array:
    """The frame `4 x 4` [m] of a place [mm] and a rotation `3 x 3`."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, 1e-3 * np.array(place)
    return found
