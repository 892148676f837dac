"""The figures of a diagnosis for TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.report.event_file import EventFile


def write_diagnosis_events(
    folder: Path, results: Mapping[str, Any], verdict: str, pictures: Mapping[str, Path]
) -> None:
    """Write the verdict as text, gaps (`gap/in_order`: step k has the first k effects) and probabilities as scalars,
    and the pictures as images.

    Event files of an earlier diagnosis in the same folder are removed, for TensorBoard would mix the two.

    Args:
        folder: where the event files go.
        results: as in `diagnosis.json`.
        verdict: its two sentences.
        pictures: PNG files by name.
    """
    for old in folder.glob("events.out.tfevents.*"):
        old.unlink()
    with EventFile(folder) as writer:
        writer.add_text("diagnosis/verdict", verdict, 0)
        for key in ("gap", "gap_rotation"):
            for part in ("before", "after", "noise_floor"):
                value = (results.get(key) or {}).get(part)
                if value is not None:
                    writer.add_scalar(f"{key}/{part}", value, 0)
        for step, entry in enumerate(results.get("in_order", []), 1):
            writer.add_scalar("gap/in_order", entry["gap_after"], step)
        for part in ("before", "after"):
            if (far := results.get("by_block")) is not None:
                writer.add_scalar(f"gap/by_block_{part}", far[part], 0)
        network = results.get("network") or {}
        if network.get("gap_after") is not None:
            writer.add_scalar("gap/after_network", network["gap_after"], 0)
        for effect in results["effects"]:
            writer.add_scalar(f"probability/{effect['name']}", effect["probability"], 0)
        for name, path in pictures.items():
            writer.add_image(f"diagnosis/{name}", path.read_bytes(), 0)
