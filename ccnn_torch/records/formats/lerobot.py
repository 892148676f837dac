"""LeRobot data sets, v2 and v3: `meta/info.json`, and frames in `data/*/*.parquet`.

The form is that of huggingface/lerobot, docs/source/lerobot-dataset-v3.mdx and src/lerobot/datasets; the units those of
src/lerobot/motors/motors_bus.py: degrees, or shares of the range that a calibration found (-100 … 100, a gripper
0 … 100). No file of a data set names its unit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, parse_json, read_text
from ccnn_torch.records.formats.joints import Joints, chosen_joints, motion_table
from ccnn_torch.records.table import Table

Array = NDArray[np.float64]
# Episodes that are read where nothing is said, spread evenly; 48 pieces of a second are evaluated.
_EPISODES = 16
# Numbers in a column of one file: 1,000 hours of a 14-joint arm at 30 Hz.
_MOST = 50_000_000
_STATE, _ACTION, _TIME, _EPISODE = "observation.state", "action", "timestamp", "episode_index"
# What else may be recorded of each joint, by its key: our column by the unit that is said.
_BESIDE = {
    "effort": {"N*m": "torque", "A": "current", "mA": "current", "1": "pwm"},
    "velocity": {"rad/s": "speed", "deg/s": "speed", "m/s": "speed", "mm/s": "speed"},
}
# Beyond this an angle in radians has made more than a turn, and one in a share of its range is outside of it.
_RAD, _SHARE = 2 * np.pi, 100.5
# Steps of the encoders in a turn, as LeRobot counts.
_STEPS = 4095
_NORMALISED = "normalised"


def read(path: Path, keys: Mapping[str, Any]) -> Table:
    """Episodes as runs: `time`, `command1` … (the action) and `q1` … (the state).

    Args:
        path: of the data set.
        keys: `episodes`, how many or which; `joints`, `units` as in `chosen_joints`; `calibration`, the arm's file;
            `effort`, `velocity`, the unit of these, which are left out where it is not said.

    Raises:
        InputError: something is missing or damaged, or the unit is in doubt.
    """
    info = _info(path)
    there, moved = _names(info, _STATE, path), _names(info, _ACTION, path)
    if len(there) == len(moved) and not {*there} & {*moved}:
        # Under other names, in one order.
        moved = there
    joints, notes = chosen_joints(there, moved, keys, path)
    widths = {_STATE: len(there), _ACTION: len(moved), _TIME: 0, _EPISODE: 0}
    kinds, left = _beside(info, keys, path)
    columns, said = _frames(path, keys.get("episodes", _EPISODES), widths | dict.fromkeys(kinds, len(there)))
    state, action = (columns[key][:, places] for key, places in ((_STATE, joints.state), (_ACTION, joints.command)))
    units, factors, why = _units(joints, state, keys, path)
    beside = {word: (unit, columns[key][:, joints.state]) for key, (word, unit) in kinds.items()}
    said += [*notes, *why, *left]
    return motion_table(
        path, joints, units, columns[_TIME], action * factors, state * factors, columns[_EPISODE], said, beside
    )


def _beside(
    info: Mapping[str, Any], keys: Mapping[str, Any], path: Path
) -> tuple[dict[str, tuple[str, str]], list[str]]:
    """Our name and unit of each further feature that is read; and a sentence on each that is not."""
    found, left = {}, []
    for key, units in _BESIDE.items():
        feature, unit = f"observation.{key}", keys.get(key)
        there = feature in info["features"]
        if unit is None:
            left += [f"{feature} left out; motion_keys={{{key}: UNIT}} reads it ({', '.join(units)})"] if there else []
        elif not there or str(unit) not in units:
            why = f"write one of {', '.join(units)}, not {visible(str(unit))}" if there else f"{path} has no {feature}"
            raise InputError(f"motion_keys: {key}: {why}")
        else:
            found[feature] = (units[str(unit)], str(unit))
    return found, left


def _info(path: Path) -> Mapping[str, Any]:
    where = path / "meta" / "info.json"
    info = parse_json(
        read_text(where, CONFIG_LIMIT, "a LeRobot data set has its names there; copy it whole"), str(where)
    )
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(version, str) or not re.match(r"v?[23]\.", version):
        raise InputError(
            f"{where}: codebase_version is {visible(str(version))}, and v2.0 to v3 are read; convert the data set with "
            "LeRobot"
        )
    return info  # type: ignore[no-any-return]


def _names(info: Mapping[str, Any], key: str, path: Path) -> list[str]:
    """Names of a feature's numbers, without the ending .pos."""
    features = info.get("features")
    feature = features.get(key) if isinstance(features, dict) else None
    shape, names = (feature.get("shape"), feature.get("names")) if isinstance(feature, dict) else (None, None)
    if isinstance(names, dict):
        # By group, or each with its place.
        names = [own for own in names.values() if isinstance(own, list)] or list(names)
    if isinstance(names, list) and all(isinstance(own, list) for own in names):
        names = [name for own in names for name in own]
    if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
        raise InputError(
            f"{path}: meta/info.json has no feature '{key}' with one number for each joint; a diagnosis needs the "
            f"measured positions ({_STATE}) and the commanded ones ({_ACTION})"
        )
    if not isinstance(names, list) or len(names) != shape[0]:
        names = [f"joint_{i + 1}" for i in range(shape[0])]
    return [visible(str(name), 40).removesuffix(".pos") for name in names]


def _frames(path: Path, wanted: Any, widths: Mapping[str, int]) -> tuple[dict[str, Array], list[str]]:
    """Features of the frames of some episodes, and what was left out; widths: numbers of each, 0 of a plain column."""
    try:
        import pyarrow as pa
        from pyarrow import compute, parquet
    except ImportError:
        raise InputError(
            f"{path}: reading a LeRobot data set needs pyarrow; install it with pip install 'ccnn-torch[lerobot]'"
        ) from None
    files = sorted(path.glob("data/*/*.parquet"))
    if not files:
        raise InputError(f"{path}: has no data/*/*.parquet; copy the data set whole (the videos are not needed)")
    file = files[0]
    try:
        there: dict[Path, list[int]] = {}
        for file in files:
            number = re.fullmatch(r"episode_(\d+)", file.stem)
            column = () if number else parquet.read_table(file, columns=[_EPISODE])[_EPISODE].unique().to_pylist()
            there[file] = [int(number[1])] if number else sorted(column)
        every = sorted({episode for own in there.values() for episode in own})
        if not every:
            raise InputError(f"{path}: has no frame; record at least one episode")
        kept = _kept(every, wanted, path)
        parts: dict[str, list[Array]] = {key: [] for key in widths}
        for file in (file for file, own in there.items() if kept & set(own)):
            _check_size(parquet.ParquetFile(file), file, widths)
            table = parquet.read_table(file, columns=list(parts), filters=[(_EPISODE, "in", kept)])
            for key, width in widths.items():
                column = table[key].combine_chunks()
                if width and set(compute.list_value_length(column).unique().to_pylist()) != {width}:
                    raise InputError(f"{file}: '{key}' has not {width} numbers in each row, as meta/info.json says")
                flat = compute.list_flatten(column) if width else column
                values = flat.cast(pa.float64()).to_numpy(zero_copy_only=False)
                parts[key].append(values.reshape(-1, width) if width else values)
    except (pa.ArrowException, OSError, KeyError, TypeError) as reason:
        first = (str(reason).splitlines() or ["it is damaged"])[0]
        raise InputError(f"{file}: is no data file of a LeRobot data set: {visible(first, 120)}") from None
    left = len(every) - len(kept)
    many = f"{len(kept)} of {len(every)} episodes were read; motion_keys={{episodes: {len(every)}}} reads all"
    return {key: np.concatenate(own) for key, own in parts.items()}, [many] if left else []


def _check_size(file: Any, where: Path, names: Mapping[str, int]) -> None:
    """Refuse a file whose columns unfold to more numbers than a machine records."""
    about = file.metadata
    for group in range(about.num_row_groups):
        for k in range(about.num_columns):
            column = about.row_group(group).column(k)
            if column.path_in_schema.partition(".list")[0] in names and column.num_values > _MOST:
                raise InputError(
                    f"{where}: has {column.num_values:,} numbers in one column; more than {_MOST:,} are not read"
                )


def _kept(every: Sequence[int], wanted: Any, path: Path) -> set[int]:
    """Episodes to read; wanted: how many, or a list of them."""
    if isinstance(wanted, list):
        lost = [number for number in wanted if number not in every]
        if lost or not wanted:
            raise InputError(
                f"motion_keys: episodes: {path} has no episode {lost[0] if lost else '(the list is empty)'}; it has "
                f"{every[0]} to {every[-1]}"
            )
        return set(wanted)
    if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted < 1:
        raise InputError(
            f"motion_keys: episodes: write how many (16), or which ([0, 3, 7]), not {visible(str(wanted))}"
        )
    return {every[i] for i in np.unique(np.linspace(0, len(every) - 1, min(wanted, len(every))).round().astype(int))}


def _units(joints: Joints, state: Array, keys: Mapping[str, Any], path: Path) -> tuple[list[str], Array, list[str]]:
    """Unit of each joint, the factor to it, and how it is known."""
    if "calibration" in keys:
        ranges = _ranges(joints, str(keys["calibration"]))
        why = f"shares of the ranges in {keys['calibration']} were turned into degrees"
        return ["deg"] * len(ranges), ranges / 200, [why]
    units = joints.units
    if units is None:
        most = float(np.nanmax(np.abs(state), initial=0.0))
        if _RAD < most <= _SHARE:
            raise InputError(
                f"{path}: its values are within ±{most:.3g} and may be degrees or shares of a range (-100 … 100), "
                "which no file of the data set says; say motion_keys={units: deg} (--units deg in ccnn new), or where "
                "LeRobot recorded with use_degrees=false motion_keys={calibration: FILE.json}, the arm's calibration"
            )
        units = ["rad" if most <= _RAD else "deg"] * len(joints.names)
        how = "no angle is beyond a turn" if most <= _RAD else f"values reach {most:.4g}"
        return units, np.ones(len(units)), [f"positions were taken in {units[0]}: {how}"]
    if _NORMALISED in units:
        raise InputError(
            "motion_keys: units: normalised values (-100 … 100) become angles by the arm's calibration alone; say "
            "calibration: FILE.json, which LeRobot keeps in its cache under calibration/robots"
        )
    return list(units), np.ones(len(units)), []


def _ranges(joints: Joints, file: str) -> Array:
    """Degrees from -100 to 100, or from -100 of a gripper (0 is its middle) to 100, negative where it is reversed."""
    content = parse_json(read_text(file, CONFIG_LIMIT, "give the arm's calibration file"), file)
    found = []
    for name, gripper in zip(joints.names, joints.grippers, strict=True):
        own = content.get(name) if isinstance(content, dict) else None
        own = own if isinstance(own, dict) else {}
        try:
            width = float(own["range_max"]) - float(own["range_min"])
        except (TypeError, KeyError, ValueError):
            raise InputError(
                f"{file}: has no range_min and range_max of '{name}'; give this arm's calibration file"
            ) from None
        if not 0 < width <= 100 * _STEPS:
            raise InputError(f"{file}: the range of '{name}' is {width:g} steps; give this arm's calibration file")
        found.append((-1 if own.get("drive_mode") else 1) * width * 360 / _STEPS * (2 if gripper else 1))
    return np.array(found)
