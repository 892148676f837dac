"""What is found of a machine comes back in the words and units of its file: on every page and in every file."""

from __future__ import annotations

import csv
import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ccnn_torch.compensation import load_compensation
from ccnn_torch.errors import InputError
from ccnn_torch.identification.page import printer_table
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.mechanisms.kinds.machine_file import template
from ccnn_torch.records import load_records, write_table

Cli = Callable[..., tuple[int, str, str]]
Array = NDArray[np.float64]
UM = 1e-6


def _gantry(folder: Path, seed: int) -> dict[str, float]:
    """Rows of a gantry seen by a tracker that stands anywhere, in numpy alone; its numbers in µm/m."""
    rng = np.random.default_rng(seed)
    names = ("lead x", "lead y", "lead z", "squareness xy", "squareness xz", "squareness yz")
    numbers = dict(zip(names, rng.normal(0, [150, 150, 150, 400, 400, 400]), strict=True))
    lead = np.array([numbers[f"lead {a}"] for a in "xyz"]) * UM
    xy, xz, yz = (numbers[f"squareness {a}"] * UM for a in ("xy", "xz", "yz"))
    axes = np.array([[1, 0, 0], [np.sin(xy), np.cos(xy), 0], [np.sin(xz), np.sin(yz), np.sqrt(1 - xz**2 - yz**2)]])
    joints = rng.uniform(0, [1.2, 0.8, 0.3], (60, 3))
    turn, _ = np.linalg.qr(rng.normal(0, 1, (3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    seen = (joints * (1 + lead)) @ axes @ turn.T + rng.uniform(-2, 2, 3) + rng.normal(0, 3e-6, (60, 3))
    columns = {f"q{k + 1}[m]": joints[:, k] for k in range(3)} | {f"{a}[m]": seen[:, k] for k, a in enumerate("xyz")}
    write_table(folder / "gantry.csv", columns)
    (folder / "gantry.yaml").write_text(template("gantry"))
    return numbers


def test_a_gantry_has_squareness_and_leads(tmp_path: Path, cli: Cli) -> None:
    numbers = _gantry(tmp_path, 0)
    out = tmp_path / "found"
    words = (f"records={tmp_path / 'gantry.csv'}", f"mechanism={tmp_path / 'gantry.yaml'}", "save_report=false")
    code, screen, _ = cli("identify", *words, "--details", "--out", out)
    assert code == 0 and "squareness xy [µm/m]" in screen and "all 12 values are determined" in screen
    assert "squareness xy [µm/m]" in (out / "identified.md").read_text()
    rows = list(csv.DictReader((out / "identified.csv").read_text().splitlines()))
    told = {(r["name"], r["quantity"]): float(r["value"]) for r in rows if r["subject"] == "number"}
    assert {r["unit"] for r in rows if r["subject"] == "number"} == {"um/m"}
    for name, value in numbers.items():
        assert abs(told[name, "value"] - value) < 3.5 * told[name, "sd"] < 40
    found = json.loads((out / "identified.json").read_text())["parameters"]["squareness_xy"]
    assert (found["word"], found["shown"], found["unit"]) == ("squareness xy", "um/m", "rad")
    code, _, said = cli("identify", tmp_path / "gantry.yaml")
    assert code == 2 and "the file of a machine, no config; write mechanism=" in said
    # The file is a machine again, with its words; a URDF would lose the leads.
    again = {p.name: p for p in load_mechanism(str(out / "identified.yaml")).geometry}
    assert again["squareness_xy"].word == "squareness xy" and not (out / "identified.urdf").exists()


def test_a_diagnosis_tells_the_geometry_in_these_words(tmp_path: Path, cli: Cli) -> None:
    numbers = _gantry(tmp_path, 2)
    records, machine = tmp_path / "gantry.csv", tmp_path / "gantry.yaml"
    effects = ("--effects", "geometry,joint_gain,coupling,instrument", "--no-network", "--quiet")
    code, _, _ = cli("diagnose", "--records", records, "--mechanism", machine, *effects, "--out", tmp_path / "why")
    assert code == 0
    page = (tmp_path / "why" / "diagnosis.md").read_text()
    largest = max(numbers, key=lambda n: abs(numbers[n]))
    assert f"{largest} " in page and "µm/m" in page
    found = json.loads((tmp_path / "why" / "diagnosis.json").read_text())
    assert found["verdict"]["effects"] == ["geometry"]
    block = next(e for e in found["effects"] if e["name"] == "geometry")["parameters"]["lead_x"]
    assert (block["word"], block["shown"]) == ("lead x", "um/m")


PITCH = [[0, 0.3, 1.0], [2e-6, 14e-6, -7e-6]]


def _reached(joints: Array, error: bool = True) -> Array:
    """Where a gantry of 1000 x 800 x 300 mm is, its table of x known: x too long, y leaning."""
    place = joints + np.interp(joints[:, 0], *PITCH)[:, None] * [1, 0, 0]
    if error:
        place[:, 0] += 80 * UM * joints[:, 0] + 120 * UM * joints[:, 1]
    return np.asarray(place)


def _measured(reached: Array, folder: Path, joints: Array, rng: np.random.Generator) -> Path:
    """Rows of a tracker that stands anywhere."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    seen = reached @ turn.T + [2, 1, 0.5] + rng.normal(0, 1.5e-6, joints.shape)
    columns = {f"q{k + 1}[m]": joints[:, k] for k in range(3)} | {f"{a}[m]": seen[:, k] for k, a in enumerate("xyz")}
    write_table(folder / "r.csv", columns)
    return folder / "r.csv"


def test_numbers_are_found_beyond_a_known_table_and_commanded_away(tmp_path: Path, cli: Cli) -> None:
    rng = np.random.default_rng(1)
    joints = rng.uniform(0, [1, 0.8, 0.3], (150, 3))
    records, machine, out = _measured(_reached(joints), tmp_path, joints, rng), tmp_path / "g.yaml", tmp_path / "found"
    table = "pitch_errors: {q1: {at: [0 mm, 300 mm, 1000 mm], error: [2 um, 14 um, -7 um]}}"
    machine.write_text(f"{template('gantry')}{table}\n")
    code, _, told = cli("identify", f"records={records}", f"mechanism={machine}", "save_report=false", "--out", out)
    assert code == 0, told
    found = json.loads((out / "identified.json").read_text())["parameters"]
    assert abs(found["squareness_xy"]["value"] - 120 * UM) < 3.5 * found["squareness_xy"]["sd"] < 4e-6
    assert abs(found["lead_x"]["value"] - 80 * UM) < 3.5 * found["lead_x"]["sd"] < 4e-6
    # On the true machine, but for where it stands.
    fresh = rng.uniform(0.01, [0.99, 0.79, 0.29], (80, 3))
    command = np.asarray(load_compensation(out / "identified.yaml")(fresh)["command"])
    left, before = (_reached(q) - _reached(fresh, False) for q in (command, fresh))
    assert _beside_a_motion(left, fresh) < 1.5e-6 < 0.1 * _beside_a_motion(before, fresh)
    # The controller's own C has the table.
    code, _, told = cli("export", out / "identified.yaml", "--to", "c99", "--out", tmp_path / "c")
    assert code == 0, told
    told = subprocess.run(["make", "-s", "test"], cwd=tmp_path / "c", capture_output=True, text=True).stdout
    assert told.startswith("0 of ")


def test_bent_and_twisted_guides_are_told_and_commanded_away(tmp_path: Path, cli: Cli) -> None:
    """x carries y, y carries z: x bows by 30 µm towards y and pitches what it carries by 40 µrad to each side."""

    def reached(q: Array) -> Array:
        u = 2 * q[:, :1] - 1
        pitch = 40e-6 * u * np.stack([q[:, 2], 0 * q[:, 2], 0 * q[:, 2]], -1)
        return np.asarray(q + 30 * UM * (1 - u**2) * [0, 1, 0] + pitch)

    rng = np.random.default_rng(2)
    joints = rng.uniform(0, [1, 0.8, 0.3], (120, 3))
    records, machine = _measured(reached(joints), tmp_path, joints, rng), tmp_path / "g.yaml"
    machine.write_text(template("gantry"))
    about = ("--records", records, "--mechanism", machine, "--no-network", "--quiet")
    code, _, told = cli("diagnose", *about, "--out", tmp_path / "why")
    assert code == 0, told
    said = json.loads((tmp_path / "why" / "diagnosis.json").read_text())
    assert said["verdict"]["effects"] == ["error_motion"]
    assert "Error motion of the axis of joint 1: y 2 -19.8 µm" in (tmp_path / "why" / "diagnosis.md").read_text()
    fresh = rng.uniform(0.01, [0.99, 0.79, 0.29], (80, 3))
    write_table(tmp_path / "t.csv", {f"q{k + 1}[m]": fresh[:, k] for k in range(3)})
    code, _, told = cli("compensate", tmp_path / "why" / "diagnosis.json", tmp_path / "t.csv", tmp_path / "c.csv")
    assert code == 0, told
    with (tmp_path / "c.csv").open() as file:
        command = np.array([[float(row[f"command_q{k}[m]"]) for k in (1, 2, 3)] for row in csv.DictReader(file)])
    left, before = (reached(q) - fresh for q in (command, fresh))
    assert _beside_a_motion(left, fresh) < 0.1 * _beside_a_motion(before, fresh)


def _beside_a_motion(gap: Array, place: Array) -> float:
    """RMS over rows of what a shift and a small turn of the whole leave of gaps `s x 3` [m]."""
    eye = np.eye(3)
    columns = [np.broadcast_to(e, gap.shape) for e in eye] + [np.cross(e, place) for e in eye]
    design = np.stack(columns, -1).reshape(-1, 6)
    left = gap.ravel() - design @ np.linalg.lstsq(design, gap.ravel(), rcond=None)[0]
    return float(np.sqrt(np.square(left).sum() / len(gap)))


def test_a_coupling_of_a_scara_is_told_by_the_turn(tmp_path: Path, cli: Cli) -> None:
    """The same effect as a number of the file goes by the same word."""
    rng = np.random.default_rng(2)
    q = rng.uniform([-2, -2, -0.2, -6], [2, 2, 0, 6], (80, 4))
    x = 0.3 * np.cos(q[:, 0]) + 0.25 * np.cos(q[:, 0] + q[:, 1])
    y = 0.3 * np.sin(q[:, 0]) + 0.25 * np.sin(q[:, 0] + q[:, 1])
    place = np.stack([x, y, q[:, 2] + 0.15e-3 * q[:, 3] / (2 * np.pi)], -1) + rng.normal(0, 5e-6, (80, 3))
    units = ("rad", "rad", "m", "rad")
    columns = {f"q{k + 1}[{u}]": q[:, k] for k, u in enumerate(units)}
    write_table(tmp_path / "scara.csv", columns | {f"{a}[m]": place[:, k] for k, a in enumerate("xyz")})
    (tmp_path / "scara.yaml").write_text(template("scara").replace("base_frame: unknown", "base_frame: identity"))
    effects = ("--effects", "coupling,joint_offset", "--no-network", "--quiet")
    files = ("--records", tmp_path / "scara.csv", "--mechanism", tmp_path / "scara.yaml")
    code, _, _ = cli("diagnose", *files, *effects, "--out", tmp_path / "why")
    assert code == 0
    page = (tmp_path / "why" / "diagnosis.md").read_text()
    assert "quill coupling 0.1" in page and "mm/turn" in page


def test_a_machine_file_takes_a_tool_offset_as_a_check_tells_to_write_it(tmp_path: Path) -> None:
    path, text = tmp_path / "scara.yaml", template("scara")
    path.write_text(text.replace("tool_frame: identity", "tool_offset: unknown"))
    assert "tool" in load_mechanism(str(path)).unknown_frames
    path.write_text(text.replace("tool_frame: identity", "tool_offset: [40 mm, 0, 0]"))
    assert load_mechanism(str(path)).nominal[-6:-3].tolist() == [0.04, 0.0, 0.0]
    path.write_text(text + "tool_offset: unknown\n")
    with pytest.raises(InputError, match="remove one"):
        load_mechanism(str(path))


def test_rows_beyond_the_limits_of_the_file_say_so(tmp_path: Path) -> None:
    """They were identified from in silence, and commands were held at the limits."""
    (tmp_path / "gantry.yaml").write_text(template("gantry"))
    q = np.random.default_rng(0).uniform([0, 0, -0.3], [0.6, 0.4, 0], (30, 3))
    columns = {f"q{k + 1}[m]": q[:, k] for k in range(3)} | {f"{a}[m]": q[:, k] for k, a in enumerate("xyz")}
    write_table(tmp_path / "r.csv", columns)
    found = load_records(str(tmp_path / "r.csv"), load_mechanism(str(tmp_path / "gantry.yaml")))
    assert "beyond the limits of the machine's file (key limits), q3 in 30 of 30 rows" in found.doubt
    assert "hardly any" not in found.doubt
    wide = re.sub("limits: {[^}]*", "limits: {q3: [-190 m, 10 m]", template("gantry"))
    (tmp_path / "gantry.yaml").write_text(wide)
    found = load_records(str(tmp_path / "r.csv"), load_mechanism(str(tmp_path / "gantry.yaml")))
    assert "file, q3 0.27 m of 200 m: check the unit of its limits" in re.sub(r"0\.2\d+", "0.27", found.doubt)


def _printer(folder: Path) -> Path:
    path = folder / "printer.yaml"
    path.write_text("machine: delta_printer\nnumbers: {tower: [210 deg, 330 deg, 90 deg]}\n")
    return path


def test_rails_stay_straight_by_the_tolerance_of_the_machine_file(tmp_path: Path, cli: Cli) -> None:
    """Rods and radii off by up to 0.7 mm, heights of the bed alone: the rails lean no more than makers let them."""
    rng = np.random.default_rng(5)
    rod, radius = 0.25 + np.array([4e-4, -3e-4, 6e-4]), 0.13 + np.array([5e-4, -7e-4, 3e-4])
    towers, away, around = (
        np.deg2rad([210.0, 330.0, 90.0]),
        0.09 * rng.uniform(0, 1, 40) ** 0.5,
        rng.uniform(0, 6.28, 40),
    )
    gap = radius * np.exp(1j * towers) - (away * np.exp(1j * around))[:, None]
    joints = np.sqrt(rod**2 - np.abs(gap) ** 2)
    columns = {f"q{k + 1}[m]": joints[:, k] for k in range(3)} | {"z[m]": rng.normal(0, 1e-5, 40)}
    write_table(tmp_path / "bed.csv", columns)
    words = (f"records={tmp_path / 'bed.csv'}", f"mechanism={_printer(tmp_path)}", "noise=10 um", "save_report=false")
    leans = {}
    for out, more in (("own", ()), ("wide", ("constraint={kind: pose, tolerance: {rad: 0.01}}",))):
        code, screen, _ = cli("identify", *words, *more, "--details", "--out", tmp_path / out)
        assert code == 0 and "printer.cfg (Klipper)" in screen and "endstop A [mm]" in screen
        # One radius, as in the firmware: three of them and three angles would move and turn the whole printer.
        assert screen.count("delta radius [mm]") == 1 and "tower angle C" not in screen
        found = json.loads((tmp_path / out / "identified.json").read_text())["parameters"]
        leans[out] = max(abs(found[f"{name}{i}"]["value"]) for name in ("lean", "skew") for i in (1, 2, 3))
    assert leans["own"] < 6e-4 < leans["wide"]


def test_a_firmware_with_the_lines_of_printer_cfg_prints_flat_and_true(tmp_path: Path) -> None:
    """Klipper's own kinematics with the numbers of the table, on the machine with the identified ones."""
    made = load_mechanism(str(_printer(tmp_path)))
    rng = np.random.default_rng(1)
    sizes = {"rod": 6e-4, "base": 6e-4, "angle": 4e-3, "offset": 8e-4, "platform": 0.0, "lean": 0.0, "skew": 0.0}
    parameters = {
        p.name: {"nominal": p.nominal, "value": p.nominal + rng.normal() * sizes[p.name[:-1]]} for p in made.geometry
    }
    table = printer_table({"mechanism": "delta_printer", "parameters": parameters})
    assert table is not None
    write = {
        key: [row[3] for row in table.rows if row[1] == key] for key in ("arm_length", "angle", "position_endstop")
    }
    arm, angle = np.array(write["arm_length"], float), np.deg2rad(np.array(write["angle"], float))
    radius, more = (
        float(table.rows[0][3]),
        np.array([text.removeprefix("x ") for text in write["position_endstop"]], float),
    )
    # Firmware, in mm: homed at the switches, it takes each carriage to be at endstop + what its rod reaches.
    there = 300 + np.sqrt(250.0**2 - 130.0**2) + 1e3 * np.array([parameters[f"offset{i}"]["value"] for i in (1, 2, 3)])
    taken = 300 + more + np.sqrt(arm**2 - radius**2)
    around = rng.uniform(0, 2 * np.pi, 60)
    bed = 80 * np.sqrt(rng.uniform(0, 1, 60)) * np.exp(1j * around)
    carriages = np.sqrt(arm**2 - np.abs(radius * np.exp(1j * angle) - bed[:, None]) ** 2) + there - taken
    reached = _true_place(carriages, parameters)
    np.testing.assert_allclose(reached[:, 2], 0, atol=2e-3)
    pairs = np.abs(np.diff(bed))
    np.testing.assert_allclose(np.linalg.norm(np.diff(reached[:, :2], axis=0), axis=1), pairs, atol=5e-3)


def _true_place(carriages: Array, parameters: dict[str, dict[str, float]]) -> Array:
    """Where the nozzle is, from three spheres [mm]: Newton from the middle."""
    rod, base, angle = (
        np.array([parameters[f"{name}{i}"]["value"] for i in (1, 2, 3)]) for name in ("rod", "base", "angle")
    )
    centres = np.stack([1e3 * base * np.cos(angle), 1e3 * base * np.sin(angle)], -1)
    place = np.zeros((len(carriages), 3))
    for _ in range(50):
        across = place[:, None, :2] - centres
        up = place[:, 2:] - carriages
        left = (across**2).sum(-1) + up**2 - (1e3 * rod) ** 2
        slope = 2 * np.concatenate([across, up[..., None]], -1)
        place = place - np.linalg.solve(slope, left[..., None])[..., 0]
    return place


def test_the_screen_has_the_terms_of_the_telescope_that_is_shipped(tmp_path: Path, cli: Cli) -> None:
    """Its true terms are those of experiments/data/README.md."""
    data = Path(__file__).parents[2] / "experiments" / "data"
    words = (f"records={data / 'telescope.csv'}", f"mechanism={data / 'telescope.yaml'}", "save_report=false")
    code, screen, said = cli("identify", *words, "--out", tmp_path / "found")
    assert code == 0 and "all 6 values are determined" in screen, said
    assert "are in identified.json; --details shows them here." in " ".join(screen.split())
    lines = dict(line.strip().rsplit(": ", 1) for line in screen.splitlines() if " ± " in line)
    truth = {"IA": 412.0, "IE": -85.0, "CA": 34.0, "NPAE": -27.0, "AN": 61.0, "AW": -48.0}
    assert {name.split(" ")[-1] for name in lines} == set(truth) and "┃" not in screen
    for name, line in lines.items():
        value, half = (float(part.split(" ")[0]) for part in line.split(" ± "))
        assert abs(value - truth[name.split(" ")[-1]]) < 2 * half
