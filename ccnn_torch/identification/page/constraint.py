"""Tables and text of an identification by a constraint, from `identified.json`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.table import Table

BEFORE_SAYS = "Before: links nominal, the tool's offset fitted."
_HOLDERS = {
    "sockets": "the other rows of its socket put",
    "distances": "the measured distance puts",
    "plane": "the plane puts",
}


def holder(results: Mapping[str, Any]) -> str:
    """Subject and verb that say what places the tool: `the plane puts` (the tool)."""
    return _HOLDERS[results["constraint"]["kind"]]


def constraint_table(results: Mapping[str, Any]) -> Table | None:
    """Positions of plates, anchors or planes, with standard deviations."""
    about = results.get("constraint")
    if about is None:
        return None
    rows = []
    for name, block in about["unknowns"].items():
        scale, unit = display_unit(block["unit"], block["sd"] or 1.0)
        sd = "not identifiable" if block["sd"] is None else f"{number_text(block['sd'] / scale, 3)} {unit}"
        rows.append(
            (name, f"{number_text(block['value'], 6)} {block['unit']}".removesuffix(" 1"), sd.removesuffix(" 1"))
        )
    count = sum(place["rows"] for place in about["placements"])
    scale, unit = display_unit("m", about["noise"])
    source = "as given" if about["noise_known"] else "from the residuals"
    note = (
        f"{count} rows in {len(about['placements'])} groups; standard deviation of one equation "
        f"{number_text(about['noise'] / scale, 3)} {unit}, {source}. "
        "Turns count from where the nominal machine sees them."
    )
    return Table(f"What held the tool ({about['kind']})", ("unknown", "value", "standard deviation"), tuple(rows), note)
