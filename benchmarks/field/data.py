"""Public measured data, by loader: checksum, source and licence in one table; nothing is downloaded."""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.field.protocol import Arm, Floats, Ints, Rows
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import read_yaml

SHIPPED = Path(__file__).parents[2] / "experiments" / "data"
_UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "s": 1.0, "degC": 1.0}
_UNITS["1"] = 1.0


@dataclass(frozen=True)
class Source:
    """One set of rows.

    Attributes:
        files: below the folder; frame "file" numbers them.
        sha256: of the files one after the other; empty = a user's own.
        keep: rows that have this value in a column.
        frame: column of the measuring frame; night: the frames are days in one frame.
        target, published: columns that make a target; column that is 1 in the authors' own test rows.
        floor: columns of the standard deviation of a reading.
    """

    name: str
    folder: str
    sha256: str = ""
    origin: str = "your own"
    licence: str = "your own"
    files: tuple[str, ...] = ("records.csv",)
    nominal: str = "nominal.yaml"
    keep: tuple[tuple[str, int], ...] = ()
    frame: str = ""
    night: bool = False
    sockets: bool = False
    target: tuple[str, ...] = ()
    published: str = ""
    floor: tuple[str, ...] = ()


_LANDGRAF = "christianlandgraf/ipa-robot-accuracy (Landgraf et al., CASE 2021)"
_JACOBI = "pauljac7700/serial_robots_datasets (Jacobi 2025)"
_MUKCA = "platonics-delft/kinematics_calibration (Franzese et al. 2025)"
_GOAL = ("goal_x", "goal_y", "goal_z")
_PANDA = "51f062c0e1d414706674bdded2b2213100ad678ec61485ec0b24a38da958f89b"
SOURCES = (
    Source(
        "ur10_a",
        "ur10_a",
        "a082847dc94963b53b782e26c0cfd8c4bda9651b0f3de76dbeab47452fdfb4ef",
        _LANDGRAF,
        "MIT",
        target=_GOAL,
    ),
    Source(
        "ur10_b",
        "",
        "601e4789d2ffd2bef19f2f7febd317cb7d7778cb498fa9969ac532ca252e578e",
        _LANDGRAF,
        "MIT",
        ("ur10_b_500.csv",),
        "ur10.yaml",
        target=_GOAL,
        floor=("sx", "sy", "sz"),
    ),
    Source(
        "ur5",
        "",
        "b783c0fd3d4677afc24416c8751a16cebf7243cd264572a535f33f5910c5ccf9",
        _JACOBI,
        "MIT",
        ("ur5.csv",),
        "ur5.yaml",
        published="set",
    ),
    Source(
        "wam",
        "",
        "5ba4cd61355bdccebfab7d96640374036640962375ce3cc03107a5760df57e36",
        _JACOBI,
        "MIT",
        ("wam.csv",),
        "wam.yaml",
        published="set",
    ),
    *(
        Source(
            f"panda_{k}", "panda_mukca", _PANDA, _MUKCA, "MIT", keep=(("robot", k),), frame="placement", sockets=True
        )
        for k in (1, 3, 6)
    ),
    Source(
        "kuka",
        "kuka_mukca",
        "81ca28095eb02199fc2b22b5945128a97d0bb0ab654b8b0b37c3c1c1d6f1894a",
        _MUKCA,
        "MIT",
        frame="placement",
        sockets=True,
    ),
    Source(
        "panda_camera",
        "panda_camera",
        "054ee5c3d7cd9e4513a3699c06df8b113d320ff55a5fedf94548d6a5daad54d0",
        "PhilNad/robot-arm-kinematic-calibration",
        "MIT",
    ),
    Source(
        "mmt",
        "mmt_telescope",
        "4f8b01d0f63c336ddcdb8bdb3e600529afae2515d9b475f1a41d63f69e23112b",
        "MMTObservatory/pytelpoint",
        "BSD-3-Clause",
        ("mmt_20210821.csv", "mmt_20230702.csv", "mmt_20230924.csv"),
        frame="file",
        night=True,
    ),
)


@dataclass(frozen=True)
class Data:
    """One set, loaded: rows, the group of each row (`placement` or day, target, published test) and the noise floor."""

    source: Source
    rows: Rows
    group: Ints
    target: Ints | None
    published: Ints | None
    floor: float | None


def sources(folder: Path | None) -> Iterator[Source]:
    """The sets of the table, and every other folder with records.csv and nominal.yaml as a user's own."""
    yield from SOURCES
    # Of what is shipped the full sets are no sets of their own.
    known = {s.folder for s in SOURCES} | {"ur10_b", "ur5_tracker", "wam_tracker"}
    for path in sorted(folder.iterdir()) if folder is not None else []:
        there = (path / "records.csv").is_file() and (path / "nominal.yaml").is_file()
        if there and path.name not in known:
            yield Source(path.name, path.name, target=_GOAL, frame="placement", published="set")


def load(source: Source, folder: Path | None) -> Data | str:
    """The set, or a sentence why it is left out.

    Raises:
        InputError: a checksum is wrong, a column is missing or a cell is no number.
    """
    if source.folder and folder is None:
        return f"{source.name}: left out, for it is not shipped; give --data FOLDER that holds {source.folder}/"
    place = SHIPPED if not source.folder or folder is None else folder / source.folder
    paths = [place / name for name in (*source.files, source.nominal)]
    for path in paths:
        if not path.is_file():
            return f"{source.name}: left out, for {path} is not there; it comes from {source.origin}"
    *files, nominal = paths
    content = [path.read_bytes() for path in files]
    found = hashlib.sha256(b"".join(content)).hexdigest()
    if source.sha256 and found != source.sha256:
        raise InputError(f"{files[0]}: has SHA-256 {found}, not {source.sha256}; take the file that {source.name} is")
    tables = [_table(path) for path in files]
    columns = {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}
    columns["file"] = np.repeat(np.arange(float(len(tables))), [len(next(iter(t.values()))) for t in tables])
    for name, value in source.keep:
        columns = {key: column[columns[name] == value] for key, column in columns.items()}
    return _data(source, columns, arm_of(nominal), nominal, files[0])


def _data(source: Source, columns: dict[str, Floats], arm: Arm, nominal: Path, path: Path) -> Data:
    pose = ["x", "y", "z", *(n for n in ("rx", "ry", "rz") if n in columns)]
    joints = [f"q{k + 1}" for k in range(len(arm.a))]
    for name in (*joints, *pose):
        if name not in columns:
            raise InputError(f"{path}: has no column {name}; it needs {', '.join((*joints, *pose))}")
    names = tuple(n for n in columns if n in ("temperature",) or n.startswith("direction"))
    count = len(columns["x"])
    group = _numbers(columns[source.frame]) if source.frame in columns else np.zeros(count, np.int64)
    rows = Rows(
        joints=np.stack([columns[n] for n in joints], 1),
        poses=np.stack([columns[n] for n in pose], 1),
        covariates=np.stack([columns[n] for n in names], 1) if names else np.zeros((count, 0)),
        frame=group,
        names=names,
        arm=arm,
        nominal=nominal,
        sockets=source.sockets,
    )
    there = bool(source.target) and all(n in columns for n in source.target)
    # A target is a commanded place to 5 mm, in whatever orientation.
    target = _numbers(np.stack([columns[n] / 5e-3 for n in source.target], 1).round()) if there else None
    published = columns[source.published].astype(np.int64) if source.published in columns else None
    floor = float(np.sqrt(sum(np.mean(columns[n] ** 2) for n in source.floor))) if source.floor else None
    return Data(source, rows, group, target, published, floor)


def _numbers(values: Floats) -> Ints:
    return np.unique(values, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _table(path: Path) -> dict[str, Floats]:
    """Columns by name [SI]; the header is name[unit]."""
    with path.open(encoding="utf-8", newline="") as file:
        header, *lines = csv.reader(file)
    columns = {}
    for k, (name, unit) in enumerate(part.rstrip("]").split("[") if "[" in part else (part, "1") for part in header):
        if unit not in _UNITS:
            raise InputError(f"{path}: column {name} has the unit {unit}; give one of {', '.join(_UNITS)}")
        try:
            columns[name] = np.array([float(line[k]) for line in lines]) * _UNITS[unit]
        except (ValueError, IndexError):
            raise InputError(f"{path}: column {name} has a cell that is no number; every row needs one") from None
    return columns


def arm_of(path: Path) -> Arm:
    """The table of a nominal.yaml [SI].

    Raises:
        InputError: it has no Denavit-Hartenberg table, or a joint slides.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not {"a", "alpha", "d", "theta", "units"} <= content.keys():
        raise InputError(f"{path}: has no table a, alpha, d, theta with units; the benchmark takes arms with one")
    if any(sign != 1 for sign in content.get("joint_sign", ())) or "prismatic" in str(content.get("joint_types", "")):
        raise InputError(f"{path}: the benchmark takes turning joints that count as the table does (joint_sign 1)")
    scale = [_UNITS[content["units"][kind]] for kind in ("length", "angle")]
    keys = ("a", "alpha", "d", "theta")
    values = {key: np.array(content[key], np.float64) * scale[key in ("alpha", "theta")] for key in keys}
    return Arm(str(content.get("convention", "")).startswith("modified"), **values)
