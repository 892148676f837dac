"""What an identified delta printer writes into `printer.cfg` of Klipper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ccnn_torch.compensation.targets.machines import klipper_numbers
from ccnn_torch.records.formats.klipper import STEPPERS
from ccnn_torch.report.table import Table


def printer_table(results: Mapping[str, Any]) -> Table | None:
    """Sections and keys with what was there and what to write; None for another machine.

    An endstop is told as what to add to it.
    """
    if results["mechanism"] != "delta_printer":
        return None
    was, now = (
        klipper_numbers({name: p[when] for name, p in results["parameters"].items()}) for when in ("nominal", "value")
    )
    rows = [("[printer]", "delta_radius", f"{1e3 * was[0]:.3f}", f"{1e3 * now[0]:.3f}")]
    for i, stepper in enumerate(STEPPERS):
        rows.append((f"[{stepper}]", "arm_length", f"{1e3 * was[1][i]:.3f}", f"{1e3 * now[1][i]:.3f}"))
        rows.append(("", "angle", f"{was[2][i]:.4f}", f"{now[2][i]:.4f}"))
        rows.append(("", "position_endstop", "x", f"x {1e3 * (now[3][i] - was[3][i]):+.3f}"))
    note = (
        "In mm and degrees; x is the position_endstop that was there. Lean and skew of the rails have no key in "
        "Klipper: identified.yaml holds them."
    )
    return Table("printer.cfg (Klipper)", ("section", "key", "was", "write"), tuple(rows), note, to_type=True)
