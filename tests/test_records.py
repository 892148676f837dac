"""Records: SI tensors in the mechanism's order, a note for what is left out, a sentence for what is wrong."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.records import Records, check_rows, load_records, write_table
from ccnn_torch.records.read_table import read_parts


@dataclass(frozen=True)
class Slide:
    """Two slides and a turntable, known frames: reachable within 1 m."""

    name: str = "slide"
    joints: tuple[Coordinate, ...] = (Coordinate("q1", "m"), Coordinate("q2", "rad"))
    pose: tuple[Coordinate, ...] = (Coordinate("y", "m"), Coordinate("phi", "rad"))
    orientations: tuple[str, ...] = ()

    def reachable(self, pose: Tensor) -> Tensor:
        return pose[..., 0].abs() <= 1.0


@dataclass(frozen=True)
class Arm:
    """A serial arm with unknown frames."""

    name: str = "arm"
    joints: tuple[Coordinate, ...] = (Coordinate("q1", "rad"), Coordinate("q2", "rad"))
    pose: tuple[Coordinate, ...] = (
        *(Coordinate(name, "m") for name in "xyz"),
        *(Coordinate(name, "rad") for name in ("rx", "ry", "rz")),
    )
    orientations: tuple[str, ...] = ("rotation_vector", "quaternion", "none")
    unknown_frames: tuple[str, ...] = ("base", "tool")
    reach: float = 1.0


ROWS = 12


def slide_columns() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {
        "y[mm]": rng.uniform(-500, 500, ROWS),
        "q2[deg]": rng.uniform(-90, 90, ROWS),
        "temperature[degC]": rng.uniform(20, 30, ROWS),
        "q1[mm]": rng.uniform(100, 200, ROWS),
        "phi[rad]": rng.uniform(-0.3, 0.3, ROWS),
        "goal_y[mm]": rng.uniform(-500, 500, ROWS),
        "row[1]": np.arange(ROWS),
    }


def arm_columns(orientation: str = "rotation_vector") -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    columns = {f"q{k}[rad]": rng.uniform(-3, 3, ROWS) for k in (1, 2)}
    columns |= {f"{name}[mm]": rng.uniform(-900, 900, ROWS) for name in "xyz"}
    turn = Rotation.random(ROWS, rng=np.random.default_rng(5))
    if orientation == "rotation_vector":
        columns |= {f"r{name}[rad]": v for name, v in zip("xyz", turn.as_rotvec().T, strict=True)}
    if orientation == "quaternion":
        columns |= {f"q{name}[1]": v for name, v in zip("xyzw", turn.as_quat().T, strict=True)}
    return columns


def load(folder: Path, columns: dict[str, np.ndarray], mechanism: Slide | Arm, **keys: list[str]) -> Records:
    write_table(folder / "records.csv", columns)
    return load_records(folder / "records.csv", mechanism, **keys)


def fails(folder: Path, columns: dict[str, np.ndarray], mechanism: Slide | Arm, **keys: list[str]) -> str:
    with pytest.raises(InputError) as caught:
        check_rows(load(folder, columns, mechanism, **keys), mechanism)
    text = str(caught.value)
    assert "records.csv" in text and "\n" not in text
    return text


def renamed(columns: dict[str, np.ndarray], old: str, new: str) -> dict[str, np.ndarray]:
    return {new if header == old else header: values for header, values in columns.items()}


def test_si_in_the_order_of_the_mechanism(tmp_path: Path) -> None:
    columns = slide_columns()
    records = load(tmp_path, columns, Slide())
    check_rows(records, Slide())
    assert len(records) == ROWS and records.orientation is None
    for tensor in (records.joints, records.pose, records.covariates):
        assert tensor.dtype == torch.float64
    expected = np.stack([columns["q1[mm]"] * 1e-3, np.deg2rad(columns["q2[deg]"])], 1)
    np.testing.assert_allclose(records.joints.numpy(), expected, rtol=1e-14)
    expected = np.stack([columns["y[mm]"] * 1e-3, columns["phi[rad]"]], 1)
    np.testing.assert_allclose(records.pose.numpy(), expected, rtol=1e-14)
    np.testing.assert_allclose(records.positions.numpy(), expected[:, :1], rtol=1e-14)
    np.testing.assert_allclose(records.covariates.numpy(), columns["temperature[degC]"][:, None] + 273.15, rtol=1e-14)
    assert records.covariate_coordinates == (Coordinate("temperature", "K"),)
    assert set(records.columns) == {"temperature", "goal_y", "row"}
    np.testing.assert_allclose(records.columns["goal_y"], columns["goal_y[mm]"] * 1e-3, rtol=1e-14)
    assert any("goal_y, row" in note for note in records.notes)


def test_every_default_covariate_and_no_other(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    extra = {"time[min]": "s", "load_y[N]": "N", "load_phi[N*m]": "N*m", "load_z[kN]": "N", "direction1[1]": "1"}
    extra |= {"speed_q1[mm/s]": "m/s", "speed[rpm]": "rad/s", "loading[1]": "", "times[s]": "", "my_speed[1]": ""}
    columns = slide_columns() | {header: rng.normal(size=ROWS) for header in extra}
    columns = {header: np.tile(values, 2) for header, values in columns.items()}
    records = load(tmp_path, columns, Slide())
    expected = {"temperature": "K"} | {h.partition("[")[0]: unit for h, unit in extra.items() if unit}
    assert {c.name: c.unit for c in records.covariate_coordinates} == expected
    assert any("ignored columns: goal_y, row, loading, times, my_speed;" in note for note in records.notes)


def test_a_payload_in_kilograms_is_a_load(tmp_path: Path) -> None:
    mass = np.linspace(0, 11, ROWS)
    records = load(tmp_path, arm_columns() | {"payload[g]": 1e3 * mass}, Arm())
    assert records.covariate_coordinates == (Coordinate("load_z", "N"),)
    np.testing.assert_allclose(records.covariates[:, 0].numpy(), -9.80665 * mass, rtol=1e-14)
    assert any("payload[g] counts as load_z" in note for note in records.notes)
    assert not any("ignored" in note for note in records.notes)
    np.testing.assert_allclose(next(read_parts(tmp_path / "records.csv", 5)).column("load_z"), -9.80665 * mass[:5])
    # Beside a load, or where it is no mass, it is one more column.
    for more in ({"payload[kg]": mass, "load_x[N]": mass}, {"payload[N]": mass}):
        records = load(tmp_path, arm_columns() | more, Arm())
        assert "load_z" not in {c.name for c in records.covariate_coordinates}
        assert any("ignored columns: payload;" in note for note in records.notes)


def test_misspelt_default_covariate_is_pointed_out(tmp_path: Path) -> None:
    records = load(tmp_path, renamed(slide_columns(), "temperature[degC]", "temprature[degC]"), Slide())
    assert records.covariates.shape == (ROWS, 0)
    assert any("'temprature' looks like 'temperature'" in note for note in records.notes)


@pytest.mark.parametrize(
    "wanted, names",
    [([], []), (["row"], ["row"]), (["row", "goal_*"], ["goal_y", "row"]), (["temperature"], ["temperature"])],
)
def test_a_list_replaces_the_default(tmp_path: Path, wanted: list[str], names: list[str]) -> None:
    records = load(tmp_path, slide_columns(), Slide(), covariates=wanted)
    assert [c.name for c in records.covariate_coordinates] == names
    assert records.covariates.shape == (ROWS, len(names))


def test_constant_covariate_is_dropped_and_constant_ignored_column_is_not_mentioned(tmp_path: Path) -> None:
    columns = slide_columns() | {"temperature[degC]": np.full(ROWS, 21.5), "goal_y[mm]": np.zeros(ROWS)}
    records = load(tmp_path, columns, Slide())
    assert records.covariates.shape == (ROWS, 0)
    assert any("'temperature' is constant (21.5 degC) and was dropped" in note for note in records.notes)
    assert not any("goal_y" in note and "constant" in note for note in records.notes)


def test_constant_joint_is_reported(tmp_path: Path) -> None:
    records = load(tmp_path, slide_columns() | {"q2[deg]": np.full(ROWS, 10.0)}, Slide())
    assert any("joint 'q2' is constant" in note for note in records.notes) and records.joints.shape == (ROWS, 2)


def test_ignored_columns_are_not_judged(tmp_path: Path) -> None:
    columns = slide_columns() | {"goal_y[mm]": np.full(ROWS, np.nan), "wear[furlongz]": np.arange(ROWS)}
    records = load(tmp_path, columns, Slide())
    assert np.isnan(records.columns["goal_y"]).all()
    assert any("furlongz" in note for note in records.notes)


@pytest.mark.parametrize("orientation", ["rotation_vector", "quaternion"])
def test_orientation_of_a_serial_arm(tmp_path: Path, orientation: str) -> None:
    records = load(tmp_path, arm_columns(orientation), Arm())
    check_rows(records, Arm())
    assert records.orientation == orientation and records.pose_coordinates == Arm().pose
    expected = Rotation.random(ROWS, rng=np.random.default_rng(5))
    back = Rotation.from_rotvec(records.pose[:, 3:].numpy())
    assert (back * expected.inv()).magnitude().max() < 1e-12
    assert all(c.name not in ("qw", "qx", "qy", "qz") for c in records.covariate_coordinates)


def test_quaternion_is_normalised_and_its_sign_is_free(tmp_path: Path) -> None:
    columns = arm_columns("quaternion")
    plain = load(tmp_path, columns, Arm()).pose
    scaled = load(
        tmp_path,
        {h: v * (-1.004 if h in ("qw[1]", "qx[1]", "qy[1]", "qz[1]") else 1) for h, v in columns.items()},
        Arm(),
    )
    assert torch.allclose(plain, scaled.pose, rtol=0, atol=1e-12)


def test_quaternion_of_wrong_norm_is_refused(tmp_path: Path) -> None:
    columns = arm_columns("quaternion")
    columns["qx[1]"][5] += 1.0
    text = fails(tmp_path, columns, Arm())
    assert "norm" in text and "line 7 (row 6)" in text


def test_no_orientation(tmp_path: Path) -> None:
    records = load(tmp_path, arm_columns("none"), Arm())
    assert records.orientation == "none" and records.pose.shape == (ROWS, 3) and len(records.pose_coordinates) == 3


@pytest.mark.parametrize(
    "old, new, parts",
    [
        ("q1[mm]", "Q1[mm]", ("no column 'q1'", "'Q1'")),
        ("phi[rad]", "psi[rad]", ("no column 'phi'", "'psi'")),
        ("q1[mm]", "stroke[mm]", ("no column 'q1'", "'q1[m]' or 'q1[mm]'")),
        ("q1[mm]", "q1[deg]", ("column 'q1'", "'deg'", "a length", "'q1[mm]'")),
        ("phi[rad]", "phi[1]", ("column 'phi'", "an angle", "'phi[deg]'")),
        ("phi[rad]", "phi[rda]", ("column 'phi'", "'rda'", "'rad'")),
        ("temperature[degC]", "temperature[V]", ("column 'temperature'", "'temperature[degC]'")),
        ("temperature[degC]", "time[degC]", ("column 'time'", "'time[s]'")),
        ("temperature[degC]", "load_y[kg]", ("column 'load_y'", "a force", "'load_y[N]'")),
        ("temperature[degC]", "load_phi[N]", ("column 'load_phi'", "a moment", "'load_phi[N*m]'")),
        ("temperature[degC]", "direction1[rad]", ("column 'direction1'", "'direction1[1]'")),
        ("temperature[degC]", "speed[mm]", ("column 'speed'", "'speed[rad/s]'")),
    ],
)
def test_wrong_column(tmp_path: Path, old: str, new: str, parts: tuple[str, ...]) -> None:
    text = fails(tmp_path, renamed(slide_columns(), old, new), Slide())
    assert all(part in text for part in parts), text


def test_missing_unit_of_a_known_column_gets_the_right_remedy(tmp_path: Path) -> None:
    path = tmp_path / "records.csv"
    path.write_text("q1,q2[rad],y[m],phi[rad]\n" + "1,2,3,4\n" * 9)
    with pytest.raises(InputError, match=r"records\.csv: column 'q1' has no unit; write 'q1\[m\]' or 'q1\[mm\]'"):
        load_records(path, Slide())
    with pytest.raises(InputError, match=r"records\.csv: column 'q1' has no unit; write 'q1\[rad\]' or 'q1\[deg\]'"):
        load_records(path, Arm())


# An empty cell of the pose was not measured (tests/test_missing_cells.py).
@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("q1[mm]", np.nan),
        ("temperature[degC]", np.nan),
        *((h, np.inf) for h in ("q1[mm]", "y[mm]", "temperature[degC]")),
    ],
)
def test_not_finite(tmp_path: Path, header: str, value: float) -> None:
    columns = slide_columns()
    columns[header] = columns[header].copy()
    columns[header][3] = value
    text = fails(tmp_path, columns, Slide())
    said = "is empty" if np.isnan(value) else "'inf'"
    assert f"column '{header.partition('[')[0]}'" in text and "line 5 (row 4)" in text and said in text


def test_incomplete_orientation(tmp_path: Path) -> None:
    columns = arm_columns()
    del columns["ry[rad]"]
    assert "no column 'ry'" in fails(tmp_path, columns, Arm())


@pytest.mark.parametrize("header, factor", [("q1[rad]", 20.0), ("rz[rad]", 30.0)])
def test_degrees_labelled_as_radians(tmp_path: Path, header: str, factor: float) -> None:
    columns = arm_columns()
    columns[header] = columns[header] * factor
    name = header.partition("[")[0]
    limit = 12.6 if name == "q1" else 6.3
    row = int(np.flatnonzero(np.abs(columns[header]) > limit)[0])
    text = fails(tmp_path, columns, Arm())
    assert f"'{name}[rad]'" in text and "looks like degrees" in text and f"write '{name}[deg]'" in text
    assert f"line {row + 2} (row {row + 1})" in text


def test_angles_of_several_turns_pass_in_degrees(tmp_path: Path) -> None:
    columns = slide_columns() | {"q2[deg]": np.linspace(-5000, 5000, ROWS)}
    assert load(tmp_path, columns, Slide()).joints[-1, 1] == pytest.approx(np.deg2rad(5000))
    columns = arm_columns() | {"rz[rad]": np.linspace(0, 6.2832, ROWS)}
    load(tmp_path, columns, Arm())


def test_too_few_rows(tmp_path: Path) -> None:
    few = {header: values[:7] for header, values in slide_columns().items()}
    text = fails(tmp_path, few, Slide())
    assert "7 rows are too few" in text and "at least 8" in text and "3 inputs" in text
    load(tmp_path, {header: values[:8] for header, values in slide_columns().items()}, Slide())


def test_no_input_that_varies(tmp_path: Path) -> None:
    columns = slide_columns() | {name: np.full(ROWS, 20.0) for name in ("q1[mm]", "q2[deg]", "temperature[degC]")}
    text = fails(tmp_path, columns, Slide())
    assert "no input varies" in text and "q1, q2" in text
    varied = columns | {"temperature[degC]": np.arange(ROWS)}
    assert load(tmp_path, varied, Slide()).covariates.shape == (ROWS, 1)


@pytest.mark.parametrize(
    "wanted, parts",
    [
        (["temprature"], ("no column 'temprature'", "did you mean 'temperature'?")),
        (["humidity"], ("no column 'humidity'", "temperature, goal_y, row")),
        (["torque_*"], ("no column 'torque_*'",)),
        (["q1"], ("'q1' is a joint",)),
        (["y"], ("'y' is the measured pose",)),
    ],
)
def test_wanted_covariate_that_cannot_be(tmp_path: Path, wanted: list[str], parts: tuple[str, ...]) -> None:
    write_table(tmp_path / "records.csv", slide_columns())
    with pytest.raises(InputError) as caught:
        load_records(tmp_path / "records.csv", Slide(), wanted)
    assert all(part in str(caught.value) for part in ("covariates", *parts))


def test_row_outside_the_workspace_is_named(tmp_path: Path) -> None:
    columns = slide_columns()
    columns["y[mm]"][[2, 9]] = 1500.0
    text = fails(tmp_path, columns, Slide())
    assert "lines 4, 11 (rows 3, 10)" in text and "workspace of slide" in text


def test_row_beyond_the_reach_of_an_arm_is_named(tmp_path: Path) -> None:
    columns = arm_columns()
    columns["z[mm]"][4] += 4000.0
    text = fails(tmp_path, columns, Arm())
    assert "line 6 (row 5)" in text and "2.5 m" in text
    assert "2 m" in fails(tmp_path, columns, Arm(unknown_frames=("base",)))
    check_rows(load(tmp_path, columns, Arm(unknown_frames=())), Arm(unknown_frames=()))
    millimetres_called_metres = {h.replace("[mm]", "[m]"): v for h, v in arm_columns().items()}
    assert "check the units" in fails(tmp_path, millimetres_called_metres, Arm())


def test_hash_belongs_to_values_and_headers(tmp_path: Path) -> None:
    columns = slide_columns()
    first = load(tmp_path, columns, Slide()).data_hash
    text = (tmp_path / "records.csv").read_text()
    (tmp_path / "records.csv").write_text(text.replace(",", ";").replace("\n", "\r\n"))
    assert load_records(tmp_path / "records.csv", Slide()).data_hash == first and len(first) == 64
    columns["row[1]"] = columns["row[1]"] + np.eye(1, ROWS)[0] * 1e-9
    assert load(tmp_path, columns, Slide()).data_hash != first
    assert load(tmp_path, renamed(slide_columns(), "row[1]", "line[1]"), Slide()).data_hash != first


def test_ten_thousand_rows_are_quick(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    columns = {f"q{k}[deg]": rng.uniform(-180, 180, 10_000) for k in (1, 2)}
    columns |= {f"{name}[mm]": rng.uniform(-900, 900, 10_000) for name in "xyz"}
    columns |= {f"r{name}[rad]": rng.uniform(-1, 1, 10_000) for name in "xyz"}
    columns |= {f"c{k}[mm]": rng.normal(size=10_000) for k in range(22)}
    write_table(tmp_path / "records.csv", columns)
    start = time.process_time()
    records = load_records(tmp_path / "records.csv", Arm())
    check_rows(records, Arm())
    assert time.process_time() - start < 0.5 and len(records) == 10_000


def test_a_joint_more_than_the_machine_has_is_no_input_without_a_word(tmp_path: Path) -> None:
    columns = slide_columns() | {"q3[rad]": np.zeros(len(slide_columns()["q1[mm]"]))}
    assert "'q3', and the machine has 2 joints" in fails(tmp_path, columns, Slide())
    write_table(tmp_path / "more.csv", columns)
    assert len(load_records(tmp_path / "more.csv", Slide(), columns={"q3": "ignore"}).joint_coordinates) == 2


def test_directions_without_a_minus_are_doubted(tmp_path: Path) -> None:
    """Backlash was told twice as large."""
    up = np.arange(ROWS) % 2
    for low, doubted in ((0, True), (-1, False)):
        write_table(tmp_path / "r.csv", slide_columns() | {"direction1[1]": np.where(up == 1, 1.0, low)})
        assert ("direction1: 0 or 1, and never -1" in load_records(tmp_path / "r.csv", Slide()).doubt) == doubted
