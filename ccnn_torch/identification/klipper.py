"""What an identified delta printer writes into `printer.cfg` of Klipper."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ccnn_torch.report.table import Table

_STEPPERS = ("stepper_a", "stepper_b", "stepper_c")
# Where Klipper has its third tower [rad].
_THIRD = math.pi / 2


def printer_table(results: Mapping[str, Any]) -> Table | None:
    """Sections and keys with what was there and what to write; None for another machine.

    Klipper has one radius and two free angles: the centre is the circle's through the three towers, and the third tower
    stands at 90°. An endstop is told as what to add to it.
    """
    if results["mechanism"] != "delta_printer":
        return None
    was, now = (_keys(results["parameters"], when) for when in ("nominal", "value"))
    rows = [("[printer]", "delta_radius", f"{1e3 * was[0]:.3f}", f"{1e3 * now[0]:.3f}")]
    for i, stepper in enumerate(_STEPPERS):
        rows.append((f"[{stepper}]", "arm_length", f"{1e3 * was[1][i]:.3f}", f"{1e3 * now[1][i]:.3f}"))
        rows.append(("", "angle", f"{was[2][i]:.4f}", f"{now[2][i]:.4f}"))
        rows.append(("", "position_endstop", "x", f"x {1e3 * (now[3][i] - was[3][i]):+.3f}"))
    note = (
        "In mm and degrees; x is the position_endstop that was there. Lean and skew of the rails have no key in "
        "Klipper: identified.yaml holds them."
    )
    return Table("printer.cfg (Klipper)", ("section", "key", "was", "write"), tuple(rows), note)


def _keys(parameters: Mapping[str, Any], when: str) -> tuple[float, list[float], list[float], list[float]]:
    """Radius [m], rods [m], angles [°] and endstops less a constant [m]."""
    rod, base, platform, angle, end = (
        np.array([parameters[f"{name}{i}"][when] for i in (1, 2, 3)])
        for name in ("rod", "base", "platform", "angle", "offset")
    )
    towers = (base - platform) * np.exp(1j * angle)
    # The circle's centre c: |t_i - c| is the same for all.
    sides = np.array([[2 * (t - towers[0]).real, 2 * (t - towers[0]).imag] for t in towers[1:]])
    centre = complex(*np.linalg.solve(sides, np.abs(towers[1:]) ** 2 - np.abs(towers[0]) ** 2))
    radius = float(abs(towers[0] - centre))
    turned = np.angle((towers - centre) * np.exp(1j * (_THIRD - np.angle(towers[2] - centre))))
    # With the nozzle on the bed in the middle a carriage is as high as its rod reaches.
    ends = end - np.sqrt(rod**2 - radius**2)
    return radius, rod.tolist(), (np.degrees(turned) % 360).tolist(), ends.tolist()
