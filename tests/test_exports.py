"""Text exports of measuring programs, in three dialects as a metrology engineer has them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_new_command import ARM, arm

from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import Table, load_records, read_table

Cli = Callable[..., tuple[int, str, str]]
TARGETS = np.random.default_rng(5).uniform((-120, -120, -600), (120, 120, -450), (40, 3))
READ = TARGETS + np.random.default_rng(6).normal(0, 0.05, TARGETS.shape)


def station_report() -> str:
    """Fixed columns in groups, with the units above them."""
    lines = [
        "Measurement Report                    12.03.2024  10:15:33",
        "Instrument: AT960-LR SN 750123   Target: T-Mac",
    ]
    lines += ["Units: Millimeters, Degrees", "Coordinate frame: A::STATION_1", ""]
    joints = "".join(f"{f'J{k + 1}':>12}" for k in range(6))
    for group, rows in enumerate(np.split(arm(60), 2)):
        lines += [f"Group: Station_{group + 1}", f"Point      {joints}{'X':>13}{'Y':>13}{'Z':>13}"]
        for k, row in enumerate(rows):
            lines.append(
                f"P{k + 1:03d}       {''.join(f'{v:12.4f}' for v in row[:6])}{''.join(f'{v:13.4f}' for v in row[6:9])}"
            )
        lines.append("")
    return "\n".join(lines)


def protocol() -> str:
    """Semicolons, decimal commas, two lines of names, one of units, and a summary."""

    def cells(values: np.ndarray) -> str:
        return ";".join(f"{v:.4f}".replace(".", ",") for v in values)

    lines = ["Messprotokoll;;;;;;;", "Gerät;C-Track;;;;;;", "Datum;12.03.2024;;;;;;", ";;;;;;;", "Nr;Soll;;;Ist;;;Temp"]
    lines += [";X;Y;Z;X;Y;Z;", ";[mm];[mm];[mm];[mm];[mm];[mm];[°C]"]
    lines += [f"{k + 1};{cells(np.r_[TARGETS[k], READ[k], 21 + 0.01 * k])}" for k in range(40)]
    return "\r\n".join([*lines, f"Mittelwert;{cells(np.r_[TARGETS.mean(0), READ.mean(0), 21.2])}", ""])


def repeated_poses() -> str:
    """Tabs, a table for each pose as ISO 9283 asks, the commanded pose above it and figures below."""
    lines = ["ISO 9283  AP/RP", "Robot: D3\tLoad: 1 kg\tSpeed: 100 %", "Units:\tmm", ""]
    for pose, (at, read) in enumerate(zip(TARGETS[:12], READ[:12], strict=True)):
        x, y, z = at
        lines += [f"Pose P{pose + 1}", f"Commanded: X = {x:.4f}  Y = {y:.4f}  Z = {z:.4f} mm", "Cycle\tX\tY\tZ"]
        rows = read + np.random.default_rng(pose).normal(0, 0.01, (5, 3))
        lines += ["\t".join([str(k + 1), *(f"{v:.4f}" for v in row)]) for k, row in enumerate(rows)]
        lines += ["\t".join(["Mean", *(f"{v:.4f}" for v in rows.mean(0))]), "AP\t0.123", "RP\t0.022", ""]
    return "\n".join(lines)


def write(path: Path, text: str, code: str = "utf-8") -> Path:
    path.write_bytes(text.encode(code))
    return path


def columns(table: Table, *names: str) -> np.ndarray:
    return np.stack([table.raw(name) for name in names], -1)


def test_fixed_columns_in_groups(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "station.txt", station_report()))
    joints = [f"J{k + 1}" for k in range(6)]
    np.testing.assert_allclose(columns(table, *joints, "X", "Y", "Z"), arm(60)[:, :9], atol=1e-4)
    assert table.raw("group").tolist() == [0.0] * 30 + [1.0] * 30 and table.declared == {
        "m": "millimeters",
        "rad": "degrees",
    }
    assert any("group 0 is 'Station_1', 1 is 'Station_2'" in note for note in table.notes)
    # Lines of the file, for whoever looks for a row.
    assert table.name_rows([30]) == "line 41 (row 31)"


def test_two_lines_of_names_one_of_units_and_decimal_commas(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "protokoll.csv", protocol(), "cp1252"))
    names = [f"{what} {axis}" for what in ("Soll", "Ist") for axis in "XYZ"]
    assert table.units == {"Nr": "", **dict.fromkeys(names, "mm"), "Temp": "°C"}
    np.testing.assert_allclose(columns(table, *names), np.c_[TARGETS, READ], atol=1e-4)
    assert any("line(s) 48 sum up others" in note for note in table.notes)


def test_a_table_for_each_pose_with_its_command_above(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "iso.txt", repeated_poses()))
    commanded = columns(table, "Commanded_X", "Commanded_Y", "Commanded_Z")
    np.testing.assert_allclose(commanded, np.repeat(TARGETS[:12], 5, axis=0), atol=1e-4)
    assert table.units["Commanded_Z"] == "mm" and table.raw("pose").tolist() == np.repeat(np.arange(12), 5).tolist()
    # The columns of a map are those of the table.
    mapped = read_table(tmp_path / "iso.txt", {"X": "x[mm]", "Cycle": "ignore"})
    assert mapped.units["x"] == "mm" and "Cycle" not in mapped


@pytest.mark.parametrize(
    ("name", "text", "mechanism", "said"),
    [
        ("station.txt", station_report(), str(ARM), '"J1": "q1[degrees]"'),
        ("protokoll.csv", protocol(), "delta", '"Soll X[mm]": "goal_x[mm]"'),
        ("iso.txt", repeated_poses(), "delta", "by: [goal_x, goal_y, goal_z]"),
    ],
)
def test_a_config_of_an_export_runs(tmp_path: Path, cli: Cli, name: str, text: str, mechanism: str, said: str) -> None:
    config = tmp_path / "robot.yaml"
    code, _, error = cli("new", write(tmp_path / name, text), "--mechanism", mechanism, "--out", config)
    assert code == 0, error
    assert said in config.read_text(encoding="utf-8")
    given = DiagnoseConfig.from_file(config)
    assert given.records is not None
    records = load_records(given.records, load_mechanism(mechanism), learns=False, columns=given.columns)
    assert len(records) == {"protokoll.csv": 40}.get(name, 60) and records.whole.all()


@pytest.mark.parametrize(
    ("above", "turn", "said", "named"),
    [
        ("Report of a tracker", 50, "a rotation vector, as Universal Robots gives it", '"Rz": "rz[degrees]"'),
        ("Report of a tracker", 170, "a rotation vector is not longer than 180 deg", '"Rz": "fanuc_r[degrees]"'),
        ("SpatialAnalyzer 2023.2", 50, "the file is of SpatialAnalyzer, whose usual", '"Rz": "fanuc_r[degrees]"'),
    ],
)
def test_what_three_angles_are_is_told_with_its_reason(
    tmp_path: Path, cli: Cli, above: str, turn: float, said: str, named: str
) -> None:
    names = ",".join([*(f"J{k + 1}" for k in range(6)), "X", "Y", "Z", "Rx", "Ry", "Rz"])
    rows = [",".join(f"{v:.3f}" for v in [*row[:9], turn, 30 + k, turn]) for k, row in enumerate(arm(20))]
    text = "\n".join([above, "Units: Millimeters, Degrees", "", names, *rows, ""])
    config = tmp_path / "robot.yaml"
    code, _, error = cli("new", write(tmp_path / "poses.txt", text), "--mechanism", ARM, "--out", config)
    told = config.read_text(encoding="utf-8") if code == 0 else error
    assert said in told and named in told, told


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("Cycle\tX\tY\tZ", "Cycle\tX\tY\tRz", 1), "has other columns than that from line"),
        (lambda t: _row(t, 8, lambda cells: cells[:-1]), "line 8 has 3 cells, but the table's names are 4"),
        (lambda t: t.replace("Cycle\tX\tY\tZ", "Cycle\tX\tX\tZ"), "column 'X' occurs twice in the header"),
        (lambda t: "\n".join(t.splitlines()[:4]), "iso.txt: "),
        (lambda t: t.replace("Cycle\tX\tY\tZ", "", 1), "lines 8 to 13 hold numbers without names above them"),
        (
            lambda t: t.replace("\n3\t", "\n3\tlost\tlost\tlost\t", 1),
            "line 10 has 7 cells, but the table's names are 4",
        ),
    ],
)
def test_what_is_refused(tmp_path: Path, cli: Cli, change: Callable[[str], str], said: str) -> None:
    path = write(tmp_path / "iso.txt", change(repeated_poses()))
    code, _, error = cli("new", path, "--mechanism", "delta", "--out", tmp_path / "robot.yaml")
    assert code == 2 and said in error and error.count("\n") == 1, error


def _row(text: str, number: int, change: Callable[[list[str]], list[str]]) -> str:
    lines = text.splitlines()
    lines[number - 1] = "\t".join(change(lines[number - 1].split("\t")))
    return "\n".join(lines)


def test_a_lost_reading_and_a_huge_one_are_named_by_their_line(tmp_path: Path) -> None:
    for cell, said in (
        ("lost", "column 'X' has 'lost' at line 9"),
        ("1e300", "at line 9 (row 2), larger than anything"),
    ):
        text = _row(repeated_poses(), 9, lambda cells, cell=cell: [cells[0], *[cell] * 3])
        table = read_table(write(tmp_path / "iso.txt", text), {"X": "X[mm]"})
        with pytest.raises(InputError) as caught:
            table.column("X", "m")
        assert said in str(caught.value)


def test_a_plain_table_stays_one(tmp_path: Path) -> None:
    # Comments above the names, and units of their own.
    path = write(tmp_path / "rows.csv", "# Units: mm\nq1[rad],x[m]\n1,2\n3,4\n")
    assert read_table(path).units == {"q1": "rad", "x": "m"} and not read_table(path).declared
    # Where a comment says the units of columns without any, they count.
    path.write_text("# Units: mm, deg\nJ1,X\n1,2\n3,4\n")
    assert read_table(path).declared == {"m": "mm", "rad": "deg"}
    # A title is passed over with a note.
    path.write_text("Line 4, May\nq1[rad];x[mm];t[s]\n1,5;2,5;1\n1,5;2,5;2\n")
    assert read_table(path).raw("q1").tolist() == [1.5, 1.5] and "passed over" in read_table(path).notes[0]


def test_a_row_of_units_counts_from_the_left_where_its_last_cells_are_blank(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("q1,q2,x,y,qw,note\nmm,deg,mm,mm,,\n" + "1,2,3,4,1,5\n" * 5)
    assert [*read_table(path).units.values()] == ["mm", "deg", "mm", "mm", "", ""]
