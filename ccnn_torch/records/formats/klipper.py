"""Klipper's `printer.cfg` of a delta printer: its numbers, and what DELTA_CALIBRATE and DELTA_ANALYZE measured.

SAVE_CONFIG keeps places as steps from the endstops (klippy/extras/delta_calibrate.py of github.com/Klipper3d/klipper),
so that they hold whatever the numbers are: a carriage is at its endstop less its steps, and an endstop at
position_endstop + √(arm_length² - delta_radius²).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text

Array = NDArray[np.float64]
_SECTION, _KEY = re.compile(r"\[([^\]]+)\]"), re.compile(r"([\w-]+)\s*[:=]\s*(.*)")
_INCLUDE = re.compile(r"\s*\[include\s+([^\]]+)\]")
_SAVED = "#*#"
STEPPERS = ("stepper_a", "stepper_b", "stepper_c")
_TOWERS = (210.0, 330.0, 90.0)
_MOST, _DEEPEST = 999, 20
# The object that is printed for DELTA_ANALYZE: six pillars around one in the middle, the first at tower A [deg, mm].
_PILLARS = np.radians(210.0 + 60.0 * np.arange(6))
_RADIUS, _RIDGE = 65.0, 4.5
_COUNTS = {"CENTER_DISTS": 6, "CENTER_PILLAR_WIDTHS": 3, "OUTER_DISTS": 6, "OUTER_PILLAR_WIDTHS": 6}
_ANALYZE = re.compile(r"DELTA_ANALYZE\s+(.*)")
_PAIR = re.compile(r"([A-Z_]+)\s*=\s*\[?([-\d.,eE +]+)")


class Printer(NamedTuple):
    """A delta printer [mm, deg].

    Attributes:
        radius: of the towers less that of the platform.
        rods, towers: length of each tower's rods, and its direction.
        heights: carriages, and the height of the nozzle there: `k x 4`.
        distances: carriages at two places, and the distance of these: `m x 7`.
    """

    radius: float
    rods: Array
    towers: Array
    heights: Array
    distances: Array


def read_printer(path: Path) -> Printer | None:
    """The printer of a file; None of another file.

    Raises:
        InputError: it lacks a key, a value is no number, or nothing was measured.
    """
    if path.suffix.lower() != ".cfg" or not path.is_file():
        return None
    text = whole_text(path)
    config = sections_of(text)
    if "kinematics" not in config.get("printer", {}):
        return None
    if config["printer"]["kinematics"] != "delta":
        raise InputError(
            f"{path}: [printer] has kinematics: {visible(config['printer']['kinematics'], 40)}; give that of a delta"
        )
    radius = _number(config, path, "printer", "delta_radius")
    rods, ends = (of_towers(config, path, key) for key in ("arm_length", "position_endstop"))
    if not (0 < radius < rods.min()):
        raise InputError(
            f"{path}: arm_length {rods.min():g} must be longer than delta_radius {radius:g}, and both above 0"
        )
    towers = np.array([_number(config, path, s, "angle", own) for s, own in zip(STEPPERS, _TOWERS, strict=True)])
    top = ends + np.sqrt(rods**2 - radius**2)
    steps = np.array([_step(config, path, s) for s in STEPPERS])
    about = config.get("delta_calibrate", {})

    def place(key: str) -> Array:
        return top - steps * _numbers(about.get(key, ""), 3, f"{path}: [delta_calibrate] {key}")

    heights = [
        [*place(f"{key}{k}_pos"), _number(config, path, "delta_calibrate", f"{key}{k}")]
        for key in ("manual_height", "height")
        for k in range(_MOST)
        if f"{key}{k}" in about
    ]
    if not heights:
        raise InputError(
            f"{path}: [delta_calibrate] has no heights; run DELTA_CALIBRATE and SAVE_CONFIG, and give the file that "
            "this wrote"
        )
    distances = [
        [
            *place(f"distance{k}_pos1"),
            *place(f"distance{k}_pos2"),
            _number(config, path, "delta_calibrate", f"distance{k}"),
        ]
        for k in range(_MOST)
        if f"distance{k}" in about
    ]
    printed = _printed(text, path, lambda xy: _carriages(xy, radius, rods, towers))
    return Printer(radius, rods, towers, np.array(heights), np.array(printed or distances).reshape(-1, 7))


def printer_files(printer: Printer, source: Path, out: Path) -> dict[Path, str]:
    """Text by path: a config for `ccnn identify`, and beside it the machine file and the tables that it names."""
    machine, bed, marks = (
        out.with_name(f"{out.stem}_{what}") for what in ("machine.yaml", "heights.csv", "distances.csv")
    )
    rods, towers = (
        ", ".join(f"{v:g} {unit}" for v in own) for own, unit in ((printer.rods, "mm"), (printer.towers, "deg"))
    )
    numbers = f"{{arm_length: [{rods}], delta_radius: {printer.radius:g} mm, tower: [{towers}]}}"
    found = {machine: f"machine: delta_printer\nnumbers: {numbers}\n", bed: _table("q1,q2,q3,z", printer.heights)}
    lines = [
        f"# By `ccnn new` of {source.name}: {len(printer.heights)} heights, {len(printer.distances)} distances.",
        "# Tolerances of its numbers are those of the kind; ccnn new --mechanism delta_printer lists them.",
        f"mechanism: {machine.name}",
    ]
    heights = f"{{kind: pose, records: {bed.name}, noise: 0.02 mm}}   # scatter of the probe"
    if len(printer.distances):
        found[marks] = _table("q1,q2,q3,q1_b,q2_b,q3_b,distance", printer.distances)
        lines += [f"records: {marks.name}", "noise: 0.05 mm   # of a distance by callipers", "constraint:"]
        lines += ["  kind: distances", "  beside:", f"    - {heights}"]
    else:
        lines += ["# Heights alone do not show the size: print and measure the object of DELTA_ANALYZE."]
        lines += [f"records: {bed.name}", "noise: 0.02 mm   # scatter of the probe", "constraint: {kind: pose}"]
    return {out: "\n".join([*lines, "split: {test: 0.15}"]) + "\n", **found}


def _table(names: str, rows: Array) -> str:
    lines = [",".join(f"{name}[mm]" for name in names.split(",")), *(",".join(f"{v:.5f}" for v in row) for row in rows)]
    return "\n".join(lines) + "\n"


def of_towers(config: Mapping[str, Mapping[str, str]], path: Path, key: str) -> Array:
    """A number of each tower, `3`; those of the others are that of the first where they have none.

    Raises:
        InputError: the first has none, or one is no number.
    """
    first = _number(config, path, STEPPERS[0], key)
    return np.array([_number(config, path, name, key, first) for name in STEPPERS])


def whole_text(path: Path, above: tuple[Path, ...] = ()) -> str:
    """The text of a file with those that it includes in their places, as Klipper reads them; above: who includes it."""
    if path.resolve() in above or len(above) > _DEEPEST:
        raise InputError(f"{path}: includes itself; remove that [include …]")
    parts = []
    for line in read_text(path, CONFIG_LIMIT).splitlines():
        found = _INCLUDE.match(line)
        parts += [line] if found is None else _included(path, found[1].strip(), (*above, path.resolve()))
    return "\n".join(parts)


def _included(path: Path, name: str, above: tuple[Path, ...]) -> list[str]:
    there = sorted(path.parent.glob(name)) if not Path(name).is_absolute() else [Path(name)]
    files = [file for file in there if file.is_file()]
    if not files and not re.search(r"[*?\[]", name):
        raise InputError(f"{path}: [include {visible(name, 60)}]: there is no such file beside it; copy it there")
    return [whole_text(file, above) for file in files]


def sections_of(text: str) -> dict[str, dict[str, str]]:
    """Values by section and key, those that SAVE_CONFIG wrote over the others."""
    found: dict[str, dict[str, str]] = {}
    section = ""
    for line in text.splitlines():
        line = line.removeprefix(_SAVED) if line.startswith(_SAVED) else re.split(r"(?:^|\s)[#;]", line)[0]
        line = line.strip()
        if match := _SECTION.match(line):
            section = match[1].strip()
        elif match := _KEY.match(line):
            found.setdefault(section, {})[match[1]] = match[2].strip()
    return found


def _number(
    config: Mapping[str, Mapping[str, str]], path: Path, section: str, key: str, usual: float | None = None
) -> float:
    text = config.get(section, {}).get(key)
    if text is None and usual is not None:
        return usual
    if text is None:
        raise InputError(f"{path}: [{section}] has no {key}; write it there")
    return float(_numbers(text, 1, f"{path}: [{section}] {key}")[0])


def _numbers(text: str, count: int, where: str) -> Array:
    try:
        found = np.array([float(part) for part in text.split(",")])
    except ValueError:
        found = np.full(0, np.nan)
    if len(found) != count or not np.isfinite(found).all():
        raise InputError(f"{where}: must be {count} number(s) with commas between them, not '{visible(text, 40)}'")
    return found


def _step(config: Mapping[str, Mapping[str, str]], path: Path, section: str) -> float:
    """Way of a carriage for each step [mm]."""
    ratio = 1.0
    for pair in filter(None, config.get(section, {}).get("gear_ratio", "").split(",")):
        first, second = _numbers(pair.replace(":", ","), 2, f"{path}: [{section}] gear_ratio")
        ratio *= first / second if second else math.nan
    turn = _number(config, path, section, "full_steps_per_rotation", 200.0)
    steps = turn * _number(config, path, section, "microsteps") * ratio
    size = _number(config, path, section, "rotation_distance")
    if not (steps > 0 and size > 0):
        raise InputError(f"{path}: [{section}] rotation_distance, microsteps and gear_ratio must be above 0")
    return size / steps


def _carriages(xy: Array, radius: float, rods: Array, towers: Array) -> Array:
    """Carriages [mm] with the nozzle at places of the bed, `k x 3`."""
    angle = np.radians(towers)
    aside = radius * np.stack([np.cos(angle), np.sin(angle)], -1) - xy[:, None]
    heights: Array = np.sqrt(rods**2 - np.square(aside).sum(-1))
    return heights


def _printed(text: str, path: Path, carriages: Callable[[Array], Array]) -> list[list[float]]:
    """Distances on the printed object, as lines `DELTA_ANALYZE CENTER_DISTS=…` give them; [] without any."""
    given = {name: values for line in _ANALYZE.findall(text) for name, values in _PAIR.findall(line)}
    if not set(_COUNTS) & set(given):
        return []
    found = {}
    for name, count in _COUNTS.items():
        if name not in given:
            raise InputError(
                f"{path}: DELTA_ANALYZE lacks {name}; write the line DELTA_ANALYZE {name}=… as it was typed"
            )
        found[name] = _numbers(given[name].strip().rstrip(","), count, f"{path}: DELTA_ANALYZE {name}")
    scale = float(_numbers(given.get("SCALE", "1").strip(), 1, f"{path}: DELTA_ANALYZE SCALE")[0])
    out = np.stack([np.cos(_PILLARS), np.sin(_PILLARS)], -1)
    near, far = _RIDGE * scale * out, (_RADIUS + _RIDGE) * scale * out
    # Along the line from the middle: opposite pillars share the width of the middle one.
    along = found["CENTER_DISTS"] - found["CENTER_PILLAR_WIDTHS"][[0, 2, 1, 0, 2, 1]]
    # From each outer pillar to the next one, parallel to the line from the middle two pillars on.
    next_near, next_far = (np.roll(own, -2, 0) + _RADIUS * scale * out for own in (near, far))
    around = found["OUTER_DISTS"] - found["OUTER_PILLAR_WIDTHS"]
    ways = ((near, far, along), (next_near, next_far, around))
    rows = [np.c_[carriages(first), carriages(second), distance] for first, second, distance in ways]
    return [list(map(float, row)) for row in np.concatenate(rows)]
