"""Positions of G-code (ISO 6983, as LinuxCNC and printers read it): straight moves, modal and incremental."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from ccnn_torch.compensation.programs.literals import (
    LEAST,
    NUMBER,
    Array,
    Edit,
    Point,
    edited,
    frame_of,
    masked,
    number_like,
)
from ccnn_torch.errors import InputError
from ccnn_torch.numerics.rotations import euler_zyx_to_matrix, matrix_to_euler_zyx, nearest_euler

_AXES = "XYZABC"
_WORD = re.compile(rf"([A-Za-z])[ \t]*({NUMBER})")
# What would put the axes elsewhere than their words say, or make other paths of them.
_REFUSED = {
    **dict.fromkeys(
        ("2", "3"), "an arc, whose centre and radius do not follow; let the CAM write short straight moves"
    ),
    **dict.fromkeys(("5", "5.1", "5.2", "6.2"), "a spline; let the CAM write short straight moves"),
    **dict.fromkeys(
        ("33", "33.1", "73", "74", "76", *map(str, range(81, 90))), "a cycle; write its moves as G0 and G1"
    ),
    **dict.fromkeys(("16", "51", "52", "68", "68.2", "92.1", "92.2", "92.3", "43.4", "7"), "another frame of the axes"),
}
_UNKNOWN_AFTER = ("28", "28.1", "29", "30", "53", "38.2", "38.3", "38.4", "38.5")


@dataclass
class _Move:
    """A block with words of axes.

    Attributes:
        spans: of the number of each word, by axis.
        old: these numbers, as they are written.
        end: of the last word.
        target: of all axes, `6` [mm, deg], NaN where they are not known.
        absolute, scale: of its words; mm for each unit.
    """

    spans: dict[str, tuple[int, int]]
    old: dict[str, str]
    end: int
    target: Array
    absolute: bool
    scale: float


@dataclass
class _State:
    motion: str = "1"
    absolute: bool = True
    scale: float = 1.0
    offset: str = ""
    at: Array = field(default_factory=lambda: np.full(6, math.nan))


class GCode:
    """A program of straight moves; A, B, C are roll, pitch and yaw where the machine has them as a pose.

    Attributes:
        points: targets of its moves.
    """

    def __init__(self, text: str, turns: bool) -> None:
        """Read it.

        Args:
            text: of the program.
            turns: whether A, B, C are of the pose; else they stay as they are.

        Raises:
            InputError: it has something that the positions of straight moves do not follow; named by line.
        """
        self._text, self._axes = text, _AXES if turns else _AXES[:3]
        self._moves: list[_Move] = []
        self.points: list[Point] = []
        self.notes: list[str] = []
        state, place, strange = _State(), 0, 0
        for number, line in enumerate(text.splitlines(keepends=True), 1):
            shown = masked(line, r"\([^)\r\n]*\)|;[^\r\n]*")
            if re.match(r"\s*/?\s*(N\d+\s*)?[A-Za-z_]{2}", shown):
                strange += 1
            else:
                self._block(shown, number, place, state)
            place += len(line)
        if strange:
            self.notes.append(
                f"{strange} lines begin with a word of letters and were left: they must not move an axis."
            )

    def _block(self, shown: str, line: int, place: int, state: _State) -> None:
        if re.fullmatch(r"\s*O\s*\d+\s*", shown, re.IGNORECASE):
            # The number of a program; words after it would make it a loop or a call.
            return
        if re.match(r"\s*[oO]\s*[<\d]", shown) or re.search(rf"[{_AXES}IJK]\s*[\[#=]", shown, re.IGNORECASE):
            raise InputError(
                f"line {line}: has a position that is computed, or a loop; give a program with the numbers themselves"
            )
        words = [
            (found[1].upper(), found[2], place + found.start(2), place + found.end(2))
            for found in _WORD.finditer(shown)
        ]
        codes = [_code(text) for letter, text, *_ in words if letter == "G"]
        for code in codes:
            if code in _REFUSED:
                raise InputError(f"line {line}: G{code} is {_REFUSED[code]}")
            state.motion = code if code in ("0", "1", "80") else state.motion
            state.absolute = {"90": True, "91": False}.get(code, state.absolute)
            state.scale = {"20": 25.4, "21": 1.0}.get(code, state.scale)
            if re.fullmatch(r"5[4-9](\.\d)?", code):
                if state.offset not in ("", code):
                    raise InputError(
                        f"line {line}: has a second work offset, G{code} after G{state.offset}; give each a program"
                    )
                state.offset = code
        mine = [word for word in words if word[0] in self._axes]
        if mine and re.search(r"\*\s*\d+\s*$", shown):
            raise InputError(
                f"line {line}: has a checksum (*), which other numbers break; give the program without them"
            )
        if ("M", "98") in [word[:2] for word in words] or "65" in codes:
            raise InputError(f"line {line}: calls another program, whose end is not known; give each program by itself")
        if "92" in codes or ("10" in codes and any(word[0] == "L" for word in words)):
            if mine or "10" in codes:
                raise InputError(f"line {line}: sets another zero of the axes; give a program without G92 and G10 L")
            return
        if set(codes) & {*_UNKNOWN_AFTER}:
            state.at[:] = math.nan
            return
        if not mine or "4" in codes:
            return
        spans = {letter: (start, end) for letter, _, start, end in mine}
        old = {letter: text for letter, text, *_ in mine}
        target = state.at.copy()
        for letter, text in old.items():
            k = _AXES.index(letter)
            value = float(text) * (state.scale if k < 3 else 1.0)
            target[k] = value if state.absolute else state.at[k] + value
        state.at = target
        self._moves.append(_Move(spans, old, max(word[3] for word in mine), target, state.absolute, state.scale))
        known = target[: len(self._axes)]
        left = "" if np.isfinite(known).all() else f"{self._lacking(known)} is not known yet"
        self.points.append(Point(line, self._frame(known) if not left else None, left=left, early=bool(left)))

    def _lacking(self, known: Array) -> str:
        return ", ".join(letter for letter, value in zip(self._axes, known, strict=True) if math.isnan(value))

    def written(self, changed: Sequence[Array | None]) -> tuple[str, list[Array | None]]:
        """The text with other targets, frames `4 x 4` [m], and what then stands there.

        A word is added where an axis that a block does not name has to move. changed: None of those that stay.
        """
        edits, stands, added = [], list[Array | None](), 0
        at = np.full(len(self._axes), math.nan)
        for move, value in zip(self._moves, changed, strict=True):
            target = move.target[: len(self._axes)]
            wanted = target if value is None else self._numbers(value, target)
            words = ""
            for k, letter in enumerate(self._axes):
                unit, scale = ("deg", 1.0) if k >= 3 else ("in" if move.scale > 1 else "mm", move.scale)
                goal, stay = (wanted[k], at[k]) if move.absolute else (wanted[k] - at[k], 0.0)
                if letter in move.spans:
                    # Nothing is known of the place before the first whole position.
                    text = move.old[letter] if math.isnan(goal) else number_like(goal / scale, move.old[letter], unit)
                    edits.append(Edit(*move.spans[letter], text))
                elif value is None or abs(goal - stay) <= scale * 10.0 ** -LEAST[unit]:
                    continue
                else:
                    text = number_like(goal / scale, "0", unit)
                    words += f" {letter}{text}"
                    added += 1
                step = float(text) * scale
                at[k] = step if move.absolute else target[k] if math.isnan(at[k]) else at[k] + step
            if words:
                edits.append(Edit(move.end, move.end, words))
            stands.append(None if value is None else self._frame(at))
        if added:
            self.notes.append(f"{added} words of axes were added, where a block moves others alone.")
        return edited(self._text, edits), stands

    def _numbers(self, frame: Array, target: Array) -> Array:
        place = 1e3 * frame[:3, 3]
        if len(self._axes) == 3:
            return place
        angles = matrix_to_euler_zyx(torch.from_numpy(frame[:3, :3].copy())).tolist()
        near = nearest_euler(angles, np.radians(target[:2:-1]).tolist())
        return np.concatenate([place, np.degrees(near[::-1])])

    def _frame(self, numbers: Array) -> Array:
        angles = torch.from_numpy(np.radians(numbers[:2:-1].copy()))
        return frame_of(numbers[:3], euler_zyx_to_matrix(angles).numpy() if len(numbers) > 3 else np.eye(3))


def _code(text: str) -> str:
    """Without leading zeros: 01 is 1."""
    return f"{float(text):g}"
