"""`ccnn new printer.cfg`: a delta printer and what Klipper's DELTA_CALIBRATE and DELTA_ANALYZE measured of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq

from ccnn_torch.records.formats.klipper import read_printer

Cli = Callable[..., tuple[int, str, str]]
Array = NDArray[np.float64]
# What Klipper takes the printer to be, and what it is [mm, deg].
RADIUS, ROD, TOWERS, END = 130.0, 250.0, np.radians([210.0, 330.0, 90.0]), 273.0
TRUE_RADIUS, TRUE_RODS = 130.3, np.array([250.3, 249.8, 250.1])
TRUE_TOWERS, LATE = np.radians([210.15, 329.8, 90.0]), np.array([-0.5, 0.3, 0.1])
STEP = 40.0 / (200 * 16)
TOP = END + np.sqrt(ROD**2 - RADIUS**2)


def carriages(x: float, y: float, z: float = 0.0) -> Array:
    """Where Klipper sends the carriages for a place of the nozzle."""
    aside = np.hypot(RADIUS * np.cos(TOWERS) - x, RADIUS * np.sin(TOWERS) - y)
    return np.sqrt(ROD**2 - aside**2) + z


def nozzle(heights: Array) -> Array:
    """Where the true printer then is: the lower point of three spheres."""
    centres = np.stack([TRUE_RADIUS * np.cos(TRUE_TOWERS), TRUE_RADIUS * np.sin(TRUE_TOWERS), heights + LATE], -1)
    planes = 2 * (centres[1:] - centres[0])
    right = TRUE_RODS[0] ** 2 - TRUE_RODS[1:] ** 2 + (centres[1:] ** 2).sum(1) - (centres[0] ** 2).sum()
    point, along = np.linalg.lstsq(planes, right, rcond=None)[0], np.cross(*planes)
    along /= np.linalg.norm(along)
    middle = along @ (point - centres[0])
    root = np.sqrt(middle**2 - ((point - centres[0]) ** 2).sum() + TRUE_RODS[0] ** 2)
    return min((point + t * along for t in (-middle - root, -middle + root)), key=lambda p: p[2])


def apart(first: Array, second: Array) -> float:
    return float(np.linalg.norm(nozzle(carriages(*first)) - nozzle(carriages(*second))))


def saved() -> str:
    """`printer.cfg` after DELTA_CALIBRATE and SAVE_CONFIG; some numbers stand above and are overruled."""
    lines = ["[stepper_a]", "step_pin: PF0", "microsteps: 16  # of the driver", "rotation_distance: 40"]
    lines += ["position_endstop: 270.0", "arm_length: 250.0", "[stepper_b]", "microsteps = 16", "rotation_distance: 80"]
    lines += [
        "gear_ratio: 4:1, 1:2",
        "[stepper_c]",
        "microsteps: 8",
        "full_steps_per_rotation: 400",
        "rotation_distance: 40",
    ]
    lines += [
        "[printer]",
        "kinematics: delta",
        "#delta_radius: 99",
        "delta_radius: 131",
        "[delta_calibrate]",
        "radius: 80",
    ]
    lines += [
        "#*# <---------------------- SAVE_CONFIG ---------------------->",
        "#*# [printer]",
        "#*# delta_radius = 130.0",
    ]
    lines += ["#*# [stepper_a]", "#*# position_endstop = 273.000000", "#*# [delta_calibrate]"]
    for k, share in enumerate([0.0, 0.95, 0.90, 0.85, 0.70, 0.75, 0.80]):
        angle = np.radians(90 + 60 * (k - 1))
        x, y = 80 * share * np.cos(angle), 80 * share * np.sin(angle)
        z = brentq(lambda z, x=x, y=y: nozzle(carriages(x, y, z))[2], -3, 3)
        steps = (TOP - carriages(x, y, z)) / STEP
        lines += [f"#*# height{k} = 0.0", f"#*# height{k}_pos = {','.join(f'{s:.3f}' for s in steps)}"]
    return "\n".join(lines) + "\n"


def analyzed() -> str:
    """The lines of DELTA_ANALYZE for a printed object, measured to 0.01 mm."""
    angles = np.radians([210, 270, 330, 30, 90, 150])
    out = np.stack([np.cos(angles), np.sin(angles)], -1)
    middle, outer = [9.48, 9.50, 9.52], [9.4, 9.5, 9.6, 9.5, 9.4, 9.5]
    centre = [apart(69.5 * d, 4.5 * d) + middle[k] for d, k in zip(out, (0, 2, 1, 0, 2, 1), strict=True)]
    ring = [
        apart(65 * out[i] + 69.5 * out[j], 65 * out[i] + 4.5 * out[j]) + outer[i]
        for i in range(6)
        for j in [(i + 2) % 6]
    ]
    values = {"CENTER_DISTS": centre, "OUTER_DISTS": ring, "CENTER_PILLAR_WIDTHS": middle, "OUTER_PILLAR_WIDTHS": outer}
    return "".join(f"# DELTA_ANALYZE {name}={','.join(f'{v:.2f}' for v in own)}\n" for name, own in values.items())


def test_what_was_measured_is_where_the_nozzle_was(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(saved() + analyzed())
    printer = read_printer(path)
    assert printer is not None and (printer.radius, *printer.rods) == (RADIUS, ROD, ROD, ROD)
    np.testing.assert_allclose([nozzle(row[:3])[2] for row in printer.heights], printer.heights[:, 3], atol=1e-4)
    told = [np.linalg.norm(nozzle(row[:3]) - nozzle(row[3:6])) for row in printer.distances]
    np.testing.assert_allclose(told, printer.distances[:, 6], atol=0.011)
    # Parts of it in files that it includes, some of them by a pattern.
    lines = saved().splitlines()
    (tmp_path / "steppers").mkdir()
    (tmp_path / "steppers" / "all.cfg").write_text("\n".join(lines[:5]))
    path.write_text("\n".join(["[include steppers/*.cfg]  # of the board", *lines[5:]]) + "\n" + analyzed())
    apart = read_printer(path)
    assert apart is not None and np.array_equal(apart.heights, printer.heights)
    # The same as Klipper keeps them, as steps.
    steps = [(TOP - row[k : k + 3]) / STEP for row in printer.distances for k in (0, 3)]
    kept = [f"#*# distance{i // 2}_pos{i % 2 + 1} = {','.join(f'{v:.3f}' for v in s)}" for i, s in enumerate(steps)]
    kept += [f"#*# distance{k} = {row[6]}" for k, row in enumerate(printer.distances)]
    path.write_text(saved() + "\n".join(kept))
    again = read_printer(path)
    assert again is not None
    np.testing.assert_allclose(again.distances, printer.distances, atol=1e-4)


def test_from_printer_cfg_to_lines_for_printer_cfg(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "printer.cfg").write_text(saved() + analyzed())
    config = tmp_path / "delta.yaml"
    code, out, error = cli("new", tmp_path / "printer.cfg", "--out", config)
    assert code == 0, error
    assert f"ccnn identify {config} out=runs/delta" in out and "delta_machine.yaml" in out
    code, _, error = cli("new", tmp_path / "printer.cfg", "--out", tmp_path / "delta.yaml")
    assert code == 2 and "is there already" in error
    code, out, error = cli("identify", config, f"out={tmp_path / 'run'}")
    # What to enter is there once.
    assert code == 0 and "Enter in printer.cfg" in out and out.count("delta_radius") == 1, error
    assert "no scale" not in out
    found = json.loads((tmp_path / "run" / "identified.json").read_text())
    position = found["methods"]["lm"]["test"]["position"]
    assert position["after"] < 0.2 * position["before"]
    truth = {"base1": TRUE_RADIUS, "angle1": TRUE_TOWERS[0] * 1e3, "rod2": TRUE_RODS[1], "offset3": LATE[2]}
    for name, value in truth.items():
        number = found["parameters"][name]
        assert abs(number["value"] - 1e-3 * value) < 2.5 * number["sd"], name
    # Heights alone are a config, too.
    (tmp_path / "printer.cfg").write_text(saved())
    code, out, error = cli("new", tmp_path / "printer.cfg", "--out", tmp_path / "basic.yaml")
    assert code == 0 and "constraint: {kind: pose}" in (tmp_path / "basic.yaml").read_text(), error
    code, out, error = cli("identify", tmp_path / "basic.yaml", f"out={tmp_path / 'bare'}", "save_report=false")
    assert code == 0 and "heights show no scale" in out, error


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda t: t.replace("kinematics: delta", "kinematics: corexy"),
            "has kinematics: corexy; give that of a delta",
        ),
        (lambda t: t.replace("height", "depth"), "has no heights; run DELTA_CALIBRATE and SAVE_CONFIG"),
        (lambda t: t.replace("microsteps: 8\n", ""), "[stepper_c] has no microsteps"),
        (
            lambda t: t.replace("arm_length: 250.0", "arm_length: 25"),
            "arm_length 25 must be longer than delta_radius 130",
        ),
        (lambda t: t.replace("arm_length: 250.0", "arm_length: long"), "[stepper_a] arm_length: must be 1 number(s)"),
        (lambda t: t.replace("gear_ratio: 4:1, 1:2", "gear_ratio: 4:0"), "must be above 0"),
        (lambda t: t.replace("height3_pos = ", "height3_pos = 1e999,"), "height3_pos: must be 3 number(s)"),
        (lambda t: "[include mcu.cfg]\n" + t, "[include mcu.cfg]: there is no such file beside it"),
        (lambda t: "[include printer.cfg]\n" + t, "printer.cfg: includes itself"),
        (lambda t: t + "# DELTA_ANALYZE CENTER_DISTS=1,2,3,4,5,6\n", "DELTA_ANALYZE lacks CENTER_PILLAR_WIDTHS"),
        (lambda t: t + analyzed().replace("_DISTS=", "_DISTS=1,"), "DELTA_ANALYZE CENTER_DISTS: must be 6 number(s)"),
    ],
)
def test_what_is_refused(tmp_path: Path, cli: Cli, change: Callable[[str], str], said: str) -> None:
    (tmp_path / "printer.cfg").write_text(change(saved()))
    code, _, error = cli("new", tmp_path / "printer.cfg", "--out", tmp_path / "delta.yaml")
    assert code == 2 and said in error and error.count("\n") == 1, error
    assert not list(tmp_path.glob("delta*"))
