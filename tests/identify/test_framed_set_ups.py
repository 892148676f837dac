"""Machines that are no serial arm, measured from two stations and with two targets; their formulas here are numpy's."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import ccnn_torch
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Framed, load_mechanism

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]
STATIONS = np.array([[1.5, -2, 0.4, 0.1, -0.05, 0.7], [-3.2, 3.8, 0.3, -0.1, 0.2, -2.0]])
TARGETS = np.array([[0.02, 0.03, 0.12, 0.1, 0, 0.2], [-0.05, 0.01, 0.2, 0, 0.3, 0]])
NOISE, TURN_NOISE = 1e-5, 3e-5
STEWART = {"mechanism": "framed", "mechanism_keys": {"mechanism": "stewart", "base": True, "tool": True}}
PER = {"frame_per": ["station"], "tool_per": ["target"]}


def _stewart(folder: Path, seed: int, rows: int = 100) -> dict[str, float]:
    """Writes records of a hexapod with errors of its joints' places; these, by name."""
    draw = np.random.default_rng(seed)
    base, platform = np.empty((6, 3)), np.empty((6, 3))
    errors: dict[str, float] = {}
    for i in range(6):
        side, place = (1 if i % 2 == 0 else -1) * np.radians(15), np.radians(120)
        ends = (
            ("B", base, 0.5, place * ((i + 1) // 2) + side),
            ("P", platform, 0.3, place / 2 + place * (i // 2) - side),
        )
        for letter, points, radius, angle in ends:
            off = draw.normal(0, 3e-4, 3)
            points[i] = np.array([radius * np.cos(angle), radius * np.sin(angle), 0]) + off
            errors |= {f"{letter}{i + 1}{axis}": float(e) for axis, e in zip("xyz", off, strict=True)}
    lines = []
    for _ in range(rows):
        at, turn = draw.uniform([-0.1, -0.1, 0.5], [0.1, 0.1, 0.7]), Rotation.from_rotvec(draw.uniform(-0.25, 0.25, 3))
        lengths = np.linalg.norm(at + turn.apply(platform) - base, axis=1)
        s, t = draw.integers(0, 2, 2)
        stand, hold = Rotation.from_rotvec(STATIONS[s, 3:]), Rotation.from_rotvec(TARGETS[t, 3:])
        seen = stand.apply(at + turn.apply(TARGETS[t, :3])) + STATIONS[s, :3] + draw.normal(0, NOISE, 3)
        angles = (stand * turn * hold * Rotation.from_rotvec(draw.normal(0, TURN_NOISE, 3))).as_rotvec()
        lines.append([*lengths, *seen, *angles, s + 1, t + 1])
    names = [f"q{i + 1}[m]" for i in range(6)] + ["x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"]
    _write(folder / "r.csv", lines, [*names, "station[1]", "target[1]"])
    return errors


def _five_bar(folder: Path, seed: int, rows: int = 120) -> dict[str, float]:
    """Writes records of a five-bar with errors of its lengths, from two stations; these, by name."""
    draw = np.random.default_rng(seed)
    errors = {name: float(draw.normal(0, 4e-4)) for name in ("l1", "L1", "l2", "L2")}
    lines: list[list[float]] = []
    while len(lines) < rows:
        q = draw.uniform([1.6, 0.2], [3.0, 1.5])
        elbows = [
            np.array([x, 0]) + (0.75 + errors[f"l{k}"]) * np.array([np.cos(a), np.sin(a)])
            for k, x, a in ((1, -0.5, q[0]), (2, 0.5, q[1]))
        ]
        way = elbows[1] - elbows[0]
        apart = float(np.linalg.norm(way))
        first, second = 1.1 + errors["L1"], 1.1 + errors["L2"]
        along = (first**2 - second**2 + apart**2) / (2 * apart)
        if first**2 - along**2 < 0.1:
            continue
        up = np.array([-way[1], way[0]]) / apart
        at = elbows[0] + along * way / apart + np.sqrt(first**2 - along**2) * up
        s = draw.integers(0, 2)
        seen = Rotation.from_rotvec(STATIONS[s, 3:]).apply([*at, 0]) + STATIONS[s, :3] + draw.normal(0, NOISE, 3)
        lines.append([*q, *seen, float(s + 1)])
    _write(folder / "r.csv", lines, ["q1[rad]", "q2[rad]", "x[m]", "y[m]", "z[m]", "station[1]"])
    return errors


def _write(path: Path, lines: list[list[float]], header: list[str]) -> None:
    np.savetxt(path, np.array(lines), "%.15g", ",", header=",".join(header), comments="")


def _distances(of: Callable[[str], float]) -> Array:
    """Of a hexapod the distances between its joints on the base, and on the platform: what no frame changes."""
    found = []
    for letter in "BP":
        points = np.array([[of(f"{letter}{i + 1}{axis}") for axis in "xyz"] for i in range(6)])
        found += [np.linalg.norm(points[i] - points[j]) for i in range(6) for j in range(i)]
    return np.array(found)


def test_a_hexapod_is_identified_from_two_stations_and_two_targets(tmp_path: Path) -> None:
    errors = _stewart(tmp_path, 1)
    keys: dict[str, Any] = {**STEWART, "mechanism_keys": STEWART["mechanism_keys"] | PER}  # type: ignore[operator]
    keys |= {"records": str(tmp_path / "r.csv"), "save_report": False, "refit": False}
    keys["noise"] = {**dict.fromkeys("xyz", NOISE), **dict.fromkeys(("rx", "ry", "rz"), TURN_NOISE)}
    keys["parameters"] = {"fixed": ["gain*", "offset*"], "prior": {"B*": "1 mm", "P*": "1 mm"}}
    found = ccnn_torch.identify(**keys)
    results = found.results
    assert results["methods"]["lm"]["converged"] == 1 and not results["doubts"]
    assert (
        results["test"]["position"]["after"] < 1.5 * np.sqrt(3) * NOISE < 1e-4 < results["test"]["position"]["before"]
    )
    told = results["parameters"]
    place = [told[f"base_{c} station 2"]["value"] for c in "xyz"]
    assert np.linalg.norm(np.array(place) - STATIONS[1, :3]) < 3e-3 and "tool_x target 1" in told
    nominal = _distances(lambda name: told[name]["nominal"])
    right = _distances(lambda name: told[name]["nominal"] + errors[name]) - nominal
    off = _distances(lambda name: told[name]["value"]) - nominal - right
    assert np.sqrt(np.mean(off**2)) < 0.15 * np.sqrt(np.mean(right**2))
    # What is written is a machine that loads, and goes on being measured in set-ups of its own.
    found.save(tmp_path / "out")
    again = load_mechanism(str(tmp_path / "out" / "identified.yaml"))
    assert isinstance(again, Framed) and again.frame_per == ("station",) and again.unknown_frames == ("base", "tool")


def test_a_five_bar_is_identified_and_diagnosed_from_two_stations(cli: Cli, tmp_path: Path) -> None:
    errors = _five_bar(tmp_path, 2)
    framed = "mechanism_keys={mechanism: five_bar, frame_per: [station]}"
    words = (f"records={tmp_path / 'r.csv'}", "mechanism=framed", framed, "save_report=false")
    more = ("parameters.fixed=[A*, k*, gamma*]", f"out={tmp_path / 'out'}")
    code, _, told = cli("identify", *words, *more)
    assert code == 0, told
    found = json.loads((tmp_path / "out" / "identified.json").read_text())["parameters"]
    for name, error in errors.items():
        assert abs(found[name]["value"] - found[name]["nominal"] - error) < 4 * found[name]["sd"] < 1e-4
    code, told, error_told = cli(
        "diagnose",
        "--records",
        tmp_path / "r.csv",
        "--mechanism",
        "framed",
        "--out",
        tmp_path / "d",
        framed,
        "effects=geometry,joint_offset",
    )
    assert code == 0, error_told
    said = json.loads((tmp_path / "d" / "diagnosis.json").read_text())
    assert said["verdict"]["effects"] == ["geometry"] and said["gap"]["after"] < 3 * NOISE
    assert said["machine"]["nominal"]["keys"].get("frame_per") is None
    parameters = said["machine"]["parameters"]
    assert max(abs(parameters[f"base_{c}"]) for c in "xyz") == 0.0


def test_a_run_of_a_five_bar_from_two_stations_has_a_frame_for_each(cli: Cli, tmp_path: Path) -> None:
    _five_bar(tmp_path, 3)
    framed = "mechanism_keys={mechanism: five_bar, frame_per: [station]}"
    words = (f"records={tmp_path / 'r.csv'}", "mechanism=framed", framed, f"out={tmp_path / 'run'}", "methods=constant")
    code, _, error = cli("run", *words, "save_report=false", "effects=none", "geometry=identify")
    assert code == 0, error
    pose = json.loads((tmp_path / "run" / "results.json").read_text())["pose"]["position"]
    # Lengths are wrong by fractions of a millimetre, stations apart by metres.
    assert pose["before"]["rms"]["median"] < 2e-3


def test_groups_of_a_frame_that_there_is_not_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tool_per needs a tool frame; write tool: true"):
        load_mechanism("framed", mechanism="stewart", tool_per=["target"])
    with pytest.raises(InputError, match="frame_per must be a list of columns"):
        load_mechanism("framed", mechanism="stewart", frame_per="station")
    with pytest.raises(InputError, match="frames per group of rows"):
        load_mechanism(
            "partial", mechanism="framed", keys={"mechanism": "stewart", "frame_per": ["station"]}, pose=["z"]
        )
    _stewart(tmp_path, 4, 30)
    keys = {**STEWART, "records": str(tmp_path / "r.csv"), "save_report": False}
    keys["mechanism_keys"] = {"mechanism": "stewart", "frame_per": ["place"]}
    with pytest.raises(InputError, match="frame_per names the column 'place', which the records lack"):
        ccnn_torch.identify(**keys)


def test_a_gantry_of_a_machine_file_is_measured_from_two_stations(tmp_path: Path) -> None:
    draw, askew = np.random.default_rng(6), 4e-4
    joints, station = draw.uniform(0, [0.5, 0.4, 0.2], (80, 3)), draw.integers(0, 2, 80)
    places = joints + askew * joints[:, [1]] * [1, 0, 0]
    seen = np.array([Rotation.from_rotvec(STATIONS[s, 3:]).apply(p) for s, p in zip(station, places, strict=True)])
    seen += STATIONS[station, :3] + draw.normal(0, NOISE, (80, 3))
    lines = np.c_[joints, seen, station + 1].tolist()
    _write(tmp_path / "r.csv", lines, ["q1[m]", "q2[m]", "q3[m]", "x[m]", "y[m]", "z[m]", "station[1]"])
    file = tmp_path / "gantry.yaml"
    file.write_text("machine: gantry\nbase_frame: unknown\nframe_per: [station]\n")
    found = ccnn_torch.identify(
        mechanism=str(file), records=str(tmp_path / "r.csv"), save_report=False, refit=False
    ).results
    assert abs(abs(found["parameters"]["squareness_xy"]["value"]) / askew - 1) < 0.05
    assert "base_x station 2" in found["parameters"]
    assert found["test"]["position"]["after"] < 1.5 * np.sqrt(3) * NOISE < 3e-5 < found["test"]["position"]["before"]
    file.write_text("machine: gantry\nframe_per: station\n")
    with pytest.raises(InputError, match="frame_per: must be a list of columns"):
        load_mechanism(str(file))
