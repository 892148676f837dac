"""Euler angles as controllers give them, against rotation matrices written by hand; and angles that would be lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from test_records import ROWS, Arm, Slide, arm_columns, slide_columns

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.records import Records, load_records, write_table
from ccnn_torch.records.headers import pose_columns

ANGLES = np.random.default_rng(8).uniform([-170, -80, -170], [170, 80, 170], (ROWS, 3))


def about_x(degrees: np.ndarray) -> np.ndarray:
    c, s, o, i = _parts(degrees)
    return _rows([[i, o, o], [o, c, -s], [o, s, c]])


def about_y(degrees: np.ndarray) -> np.ndarray:
    c, s, o, i = _parts(degrees)
    return _rows([[c, o, s], [o, i, o], [-s, o, c]])


def about_z(degrees: np.ndarray) -> np.ndarray:
    c, s, o, i = _parts(degrees)
    return _rows([[c, -s, o], [s, c, o], [o, o, i]])


def _parts(degrees: np.ndarray) -> tuple[np.ndarray, ...]:
    turn = degrees * np.pi / 180
    return np.cos(turn), np.sin(turn), np.zeros_like(turn), np.ones_like(turn)


def _rows(matrix: list[list[np.ndarray]]) -> np.ndarray:
    return np.moveaxis(np.array(matrix), -1, 0)


def load(folder: Path, names: tuple[str, ...], unit: str = "[deg]", **columns: str) -> Records:
    given = dict(zip((name + unit for name in names), ANGLES.T, strict=False))
    write_table(folder / "records.csv", arm_columns("none") | given)
    return load_records(folder / "records.csv", Arm(), columns=columns)


# The matrices: KUKA z, y', x''; Fanuc fixed x, y, z; Stäubli x, y', z''.
MATRICES = {
    "kuka": ("kuka_a", "kuka_b", "kuka_c", about_z(ANGLES[:, 0]) @ about_y(ANGLES[:, 1]) @ about_x(ANGLES[:, 2])),
    "fanuc": ("fanuc_w", "fanuc_p", "fanuc_r", about_z(ANGLES[:, 2]) @ about_y(ANGLES[:, 1]) @ about_x(ANGLES[:, 0])),
    "staubli": (
        *("staubli_rx", "staubli_ry", "staubli_rz"),
        about_x(ANGLES[:, 0]) @ about_y(ANGLES[:, 1]) @ about_z(ANGLES[:, 2]),
    ),
}


@pytest.mark.parametrize("maker", MATRICES)
def test_angles_of_a_controller(tmp_path: Path, maker: str) -> None:
    *names, matrices = MATRICES[maker]
    found = load(tmp_path, tuple(names))
    assert found.orientation == maker and [c.name for c in found.pose_coordinates] == ["x", "y", "z", "rx", "ry", "rz"]
    turned = rotation_vector_to_matrix(found.pose[:, 3:])
    torch.testing.assert_close(turned, torch.from_numpy(matrices), rtol=0, atol=1e-12)
    mapped = load(tmp_path, ("A", "B", "C"), "", **dict(zip("ABC", (f"{name}[deg]" for name in names), strict=True)))
    torch.testing.assert_close(mapped.pose, found.pose, rtol=0, atol=0)


def test_a_quarter_turn_of_each(tmp_path: Path) -> None:
    """A = 90° of KUKA turns x to y; with B = 90° after it, the tool's z points along the base's y."""
    write_table(
        tmp_path / "records.csv",
        arm_columns("none") | {f"kuka_{k}[deg]": np.full(ROWS, v) for k, v in (("a", 90.0), ("b", 90.0), ("c", 0.0))},
    )
    turned = rotation_vector_to_matrix(load_records(tmp_path / "records.csv", Arm()).pose[0, 3:])
    expected = [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]
    torch.testing.assert_close(turned, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "names, unit, parts",
    [
        (("A", "B", "C"), "[deg]", ('{"A[deg]": "kuka_a[deg]", "B[deg]": "kuka_b[deg]", "C[deg]": "kuka_c[deg]"}',)),
        (("A", "B", "C"), "", ('{"A": "kuka_a[deg]"', '{"A": ignore, "B": ignore, "C": ignore}')),
        (("W", "P", "R"), "[deg]", ('"R[deg]": "fanuc_r[deg]"',)),
        (("RX", "RY", "RZ"), "[deg]", ("map them", "kuka_a", "staubli_rx")),
        (("roll", "pitch", "yaw"), "[rad]", ("columns roll, pitch, yaw", "map them")),
        (("Euler_1",), "", ("columns Euler_1",)),
        (("QW", "QX"), "[1]", ("columns QW, QX",)),
        (("A", "B"), "[deg]", ("one of three angles is missing: give all of kuka_a, kuka_b, kuka_c",)),
    ],
)
def test_an_orientation_that_would_be_lost(
    tmp_path: Path, names: tuple[str, ...], unit: str, parts: tuple[str, ...]
) -> None:
    with pytest.raises(InputError) as caught:
        load(tmp_path, names, unit)
    text = str(caught.value)
    assert all(part in text for part in ("look like an orientation and would not be used", *parts)), text
    found = load(tmp_path, names, unit, **{name + unit: "ignore" for name in names})
    assert found.orientation == "none" and found.pose.shape == (ROWS, 3) and not set(names) & set(found.columns)


def test_what_is_no_orientation_or_is_not_missed_passes(tmp_path: Path) -> None:
    assert load(tmp_path, ("A",), "[deg]").orientation == "none"
    assert load(tmp_path, ("A", "B", "C"), "[mm]").orientation == "none"
    beside = arm_columns() | dict(zip(("A[deg]", "B[deg]", "C[deg]"), ANGLES.T, strict=True))
    write_table(tmp_path / "records.csv", beside)
    found = load_records(tmp_path / "records.csv", Arm())
    assert found.orientation == "rotation_vector" and any("ignored columns: A, B, C" in note for note in found.notes)
    write_table(tmp_path / "records.csv", slide_columns() | {"roll[deg]": ANGLES[:, 0]})
    assert any("roll" in note for note in load_records(tmp_path / "records.csv", Slide()).notes)


def test_a_hexapod_takes_a_quaternion_and_a_controllers_angles(tmp_path: Path) -> None:
    """They were left out in silence, and a part of the pose was compared."""
    machine = load_mechanism("stewart")
    joints = machine.sample_joints(20, torch.Generator().manual_seed(0))
    pose = machine.forward_kinematics(joints).numpy()
    told = {c.header: joints[:, k].numpy() for k, c in enumerate(machine.joints)}
    told |= {f"{name}[m]": pose[:, k] for k, name in enumerate("xyz")}
    for form, unit in (("quaternion", "[1]"), ("kuka", "[rad]")):
        turned = {name + unit: values for name, values in pose_columns(pose, form).items()}
        write_table(tmp_path / "records.csv", told | turned)
        np.testing.assert_allclose(load_records(tmp_path / "records.csv", machine).pose, pose, atol=1e-12)


def test_a_rotation_matrix_is_refused_and_not_lost(tmp_path: Path) -> None:
    names = [f"r{i}{k}" for i in (1, 2, 3) for k in (1, 2, 3)]
    write_table(tmp_path / "records.csv", arm_columns("none") | {f"{n}[1]": ANGLES[:, 0] for n in names})
    with pytest.raises(InputError, match="would not be used; a matrix is not read, give the quaternion"):
        load_records(tmp_path / "records.csv", Arm())


def test_a_rotation_matrix_of_a_hexapod_is_not_lost_either(tmp_path: Path) -> None:
    machine = load_mechanism("stewart")
    joints = machine.sample_joints(ROWS, torch.Generator().manual_seed(0)).numpy()
    told = {f"q{k + 1}[m]": joints[:, k] for k in range(6)} | {f"{c}[m]": joints[:, 0] for c in "xyz"}
    matrix = {f"r{i}{k}[1]": joints[:, 0] for i in (1, 2, 3) for k in (1, 2, 3)}
    write_table(tmp_path / "records.csv", told | matrix)
    with pytest.raises(InputError, match="would not be used; a matrix is not read, give the quaternion"):
        load_records(tmp_path / "records.csv", machine)


def test_angles_that_are_not_complete(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no column 'kuka_c'"):
        load(tmp_path, ("kuka_a", "kuka_b"))
