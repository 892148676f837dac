"""Planned poses as the skeleton of a robot program: a slow move to each pose, a rest, and the place of the reading."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.units import from_si

Array = NDArray[np.float64]
# Seconds of rest before a reading.
_REST = 2.0
_MOST = 6


class _Language(NamedTuple):
    """Ending of its files, and what writes a program: name, joints `s x n` [deg, mm] of at most six -> text."""

    suffix: str
    text: Callable[[str, Array], str]


def program_text(language: str, name: str, joints: Array, coordinates: Sequence[Coordinate]) -> tuple[str, str]:
    """The program of a list of joints, and the ending of its file.

    Speeds are low, and nothing is known of obstacles: a person has to look at every move first.

    Args:
        language: `krl`, `rapid`, `urscript` or `gcode`.
        name: of the program; other characters than letters, digits and _ become _.
        joints: as the controller counts them, `s x n` [SI].
        coordinates: names and SI units of the joints, `n`.

    Raises:
        InputError: more joints than six, or for `urscript` another number than six joints that turn.
    """
    units = [c.unit for c in coordinates]
    if len(units) > _MOST or (language == "urscript" and units != ["rad"] * _MOST):
        takes = "six joints that turn" if language == "urscript" else "at most six joints"
        raise InputError(f"program: {language} takes {takes}, and the machine has {len(units)}; leave out the key")
    shown = [from_si(joints[:, k], unit, "deg" if unit == "rad" else "mm") for k, unit in enumerate(units)]
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    # A name begins with a letter, and KRL's has at most 24 characters.
    plain = (plain if plain[:1].isalpha() else f"p_{plain}")[:24]
    suffix, text = LANGUAGES[language]
    return text(plain, np.stack(shown, -1)), suffix


def _krl(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = ", ".join(f"A{k} {value:.4f}" for k, value in enumerate(row, start=1))
        moves += [f"  PTP {{{axes}}}", f"  WAIT SEC {_REST}", f"  ; reading {number}"]
    return "\n".join(
        [f"DEF {name}()", "  BAS(#INITMOV, 0)", "  BAS(#VEL_PTP, 10)", "  BAS(#ACC_PTP, 10)", *moves, "END", ""]
    )


def _rapid(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = ", ".join([*(f"{value:.4f}" for value in row), *("0" for _ in range(_MOST - len(row)))])
        target = f"[[{axes}], [9E9, 9E9, 9E9, 9E9, 9E9, 9E9]]"
        moves += [f"    MoveAbsJ {target}, v50, fine, tool0;", f"    WaitTime {_REST};", f"    ! reading {number}"]
    return "\n".join([f"MODULE {name}", "  PROC main()", *moves, "  ENDPROC", "ENDMODULE", ""])


def _urscript(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = ", ".join(f"d2r({value:.4f})" for value in row)
        moves += [f"  movej([{axes}], a=0.3, v=0.2)", f"  sleep({_REST})", f'  textmsg("reading {number}")']
    return "\n".join([f"def {name}():", *moves, "end", ""])


def _gcode(name: str, joints: Array) -> str:
    moves = []
    for number, row in enumerate(joints, start=1):
        axes = " ".join(f"{letter}{value:.4f}" for letter, value in zip("XYZABC", row, strict=False))
        moves += [f"G1 {axes} F600", f"G4 P{_REST:g}", f"(reading {number})"]
    return "\n".join([f"({name}: joints of the machine as the axes X Y Z A B C)", "G21 G90 G94", *moves, "M30", ""])


LANGUAGES = {
    "krl": _Language(".src", _krl),
    "rapid": _Language(".mod", _rapid),
    "urscript": _Language(".script", _urscript),
    "gcode": _Language(".ngc", _gcode),
}
"""By the value of the key `program`."""
