"""The arrays behind a diagnosis' pictures, and what their axes are called."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.verdict.text import words_for
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import read_json

Array = NDArray[np.float64]
ARRAYS = "diagnosis.safetensors"
LABELS = "diagnosis_pictures.json"
RESULT = "diagnosis.json"
NEXT = "next_measurements.csv"
CORRECTED = tuple(f"corrected{end}" for end in (".yaml", ".urdf", "_dh.yaml"))
"""Files of the machine with the geometry that was named."""
_KNOWN_UNITS = {"x": "m", "y": "m", "z": "m", "rx": "rad", "ry": "rad", "rz": "rad", "time": "s", "temperature": "K"}


@dataclass(frozen=True)
class Signature:
    """What gives an effect away: the residual along the effect's direction against what drives it.

    Attributes:
        effect: name of the effect, or of the driver of what no effect describes.
        x: the driving joint, covariate or coordinate, `s` [x_axis.unit].
        y: the residual along the effect's direction, the other effects taken off, `s` [y_axis.unit].
        fit: the effect's fitted part of `y`, `s`.
        x_axis: name and SI unit.
        y_axis: name and SI unit.
    """

    effect: str
    x: Array
    y: Array
    fit: Array
    x_axis: Coordinate
    y_axis: Coordinate


@dataclass(frozen=True)
class About:
    """What a report shows beside `diagnosis.json`, all of it optional: the entry `about` of `diagnosis_pictures.json`.

    Attributes:
        name: title of the page.
        mechanism: what was taken for the nominal model.
        records: the file of records.
        noise: where the noise floor is from, as a sentence.
        units: SI units of joints, covariates and place coordinates by name.
        notes: further sentences.
        lines: line in the file of each row of `rows_set_aside`, the header being line 1; () where it was not asked for.
        folder: of the report, as on the command line.
        compensate: how to put the effects in a compensator: a sentence, then command lines; () where it is not known.
    """

    name: str = "Diagnosis"
    mechanism: str = ""
    records: str = ""
    noise: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    lines: tuple[int, ...] = ()
    folder: str = ""
    compensate: tuple[str, ...] = ()

    def unit(self, name: str) -> str:
        """SI unit of a column; by its name where it was not asked for, and `SI` where the name has no unit."""
        if name in self.units:
            return self.units[name]
        if name.startswith("load_"):
            return "N*m" if name.startswith("load_r") else "N"
        return "1" if name.startswith("direction") else _KNOWN_UNITS.get(name, "SI")


def about_of(labels: Mapping[str, Any]) -> About:
    """What `diagnosis_pictures.json` holds beside the axes; units of axes count as well.

    Raises:
        InputError: the entry `about` holds a key that is not known.
    """
    given = dict(labels.get("about", {}))
    if unknown := sorted(set(given) - set(About.__dataclass_fields__)):
        raise InputError(
            f"{LABELS}: 'about' holds {unknown[0]!r}, which is not known; it can hold "
            f"{', '.join(About.__dataclass_fields__)}"
        )
    axes = [block["x"] for name, block in labels.items() if name != "about"]
    given["units"] = {axis["name"]: axis["unit"] for axis in axes} | dict(given.get("units", {}))
    given |= {key: tuple(given.get(key, ())) for key in ("notes", "lines", "compensate")}
    return About(**given)


def gaps_of(results: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """The gaps that are there, by what they are of; a machine without a position has its rotation under `gap`."""
    names = words_for(results).gap
    return [(names[block["unit"]], block) for block in (results["gap"], results.get("gap_rotation")) if block]


def signatures_of(arrays: Mapping[str, Array], labels: Mapping[str, Any], names: Iterable[str] = ()) -> list[Signature]:
    """The signatures whose three arrays are there, those of `names` first."""
    there = [key[len("signature.") : -len(".x")] for key in arrays if key.startswith("signature.") and key[-2:] == ".x"]
    first = [name for name in names if name in there]
    found = []
    for effect in (*first, *sorted(set(there) - set(first))):
        if not all(f"signature.{effect}.{part}" in arrays for part in ("y", "fit")):
            continue
        x, y, fit = (np.asarray(arrays[f"signature.{effect}.{part}"]) for part in ("x", "y", "fit"))
        axes = labels.get(effect, {})
        x_axis = Coordinate(**axes.get("x", {"name": "driver", "unit": "SI"}))
        y_axis = Coordinate(**axes.get("y", {"name": "residual", "unit": "m"}))
        if np.isfinite(x + y + fit).any():
            found.append(Signature(effect, x, y, fit, x_axis, y_axis))
    return found


def used_rows(arrays: Mapping[str, Array], count: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of `count` rows were held out, and which set aside; none where the arrays do not say."""
    none = np.zeros(count)
    return np.asarray(arrays.get("held_out", none)) > 0.5, np.asarray(arrays.get("set_aside", none)) > 0.5


def load_labels(folder: Path) -> dict[str, Any]:
    """Names and units of the axes; nothing where the folder has none."""
    return read_json(folder / LABELS) if (folder / LABELS).is_file() else {}
