"""Tables with units: exact round trip, foreign dialects of CSV, and a sentence for everything that is wrong."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from ccnn_torch.errors import InputError
from ccnn_torch.records import read_table, write_table


def write(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "records.csv"
    path.write_bytes(text.encode(encoding))
    return path


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    arrays(np.float64, st.tuples(st.integers(1, 6), st.integers(1, 4)), elements=st.floats(allow_nan=False)),
)
def test_round_trip_is_exact(tmp_path: Path, values: np.ndarray) -> None:
    path = tmp_path / "t.csv"
    write_table(path, {f"c{k}[mm]": column for k, column in enumerate(values.T)})
    table = read_table(path)
    assert table.names == tuple(f"c{k}" for k in range(values.shape[1]))
    assert table.values.tobytes() == np.ascontiguousarray(values).tobytes()  # -0.0 and infinity included
    np.testing.assert_array_equal(table.lines, np.arange(len(values)) + 2)


def test_columns_come_in_si(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "q1[deg],x[mm],t[degC]\n180,1000,0\n90,-1,20\n"))
    assert len(table) == 2 and "x" in table and "y" not in table
    np.testing.assert_allclose(table.column("q1", "rad"), [np.pi, np.pi / 2])
    np.testing.assert_allclose(table.column("x", "m"), [1.0, -0.001])
    np.testing.assert_allclose(table.column("t", "K"), [273.15, 293.15])
    np.testing.assert_array_equal(table.raw("x"), [1000.0, -1.0])
    np.testing.assert_allclose(table.column("x"), [1.0, -0.001])


@pytest.mark.parametrize(
    "text",
    [
        "q1[rad],x[mm]\n0.5,1.25\n-1,2\n",
        "\ufeffq1[rad],x[mm]\n0.5,1.25\n-1,2\n",
        "q1[rad],x[mm]\r\n0.5,1.25\r\n-1,2\r\n",
        "q1[rad];x[mm]\n0,5;1,25\n-1;2\n",
        "q1[rad];x[mm]\n0.5;1.25\n-1;2\n",
        "q1[rad]\tx[mm]\n0.5\t1.25\n-1\t2\n",
        '"q1[rad]","x[mm]"\n"0.5","1.25"\n-1,2\n',
        "q1 [rad] , x [mm]\n 0.5, 1.25\n-1 ,2\n",
        "q1[rad],x[mm]\n0.5,1.25\n-1,2",
        "\n\nq1[rad],x[mm]\n\n0.5,1.25\n,\n-1,2\n\n,,\n",
        "# tracker, by hand\n; May\n// third\n% 4\nq1[rad],x[mm]\n0.5,1.25\n-1,2\n",
        "# as numpy writes it\n# q1[rad];x[mm]\n0,5;1,25\n-1;2\n",
    ],
)
def test_dialects(tmp_path: Path, text: str) -> None:
    table = read_table(write(tmp_path, text))
    np.testing.assert_array_equal(table.values, [[0.5, 1.25], [-1.0, 2.0]])
    assert table.units == {"q1": "rad", "x": "mm"}


@pytest.mark.parametrize(
    "text, parts",
    [
        ("", ("empty", "header")),
        ("\n \n", ("empty", "header")),
        ("q1[rad],x[mm]\n", ("no row",)),
        ("1.0,2.0\n1,2\n", ("line 1 must be the header", "numbers alone")),
        ("[rad],x[mm]\n1,2\n", ("'[rad]' has a unit but no name",)),
        ("q1[rad],x[mm],q1[rad]\n1,2,3\n", ("column 'q1' occurs twice",)),
        ("q1[rad],x[mm]\n1,2\n1,2,3\n", ("line 3 (row 2)", "3 cells", "2 columns")),
        ("q1[rad],x[mm]\n1,2\n\n1\n", ("line 4 (row 2)", "1 cells")),
        ("q1[rad],x[mm]\n1,5,2,5\n", ("line 2 (row 1)", "4 cells", "decimal comma")),
        ("q1[rad];x[mm]\n1;2;3\n", ("line 2 (row 1)", "3 cells")),
        ("# by hand\n; in May\nq1[rad],x[mm]\n1,2\n1\n", ("line 5 (row 2)", "1 cells")),
        ("# by hand\n1,2\n3,4\n", ("line 2 must be the header", "numbers alone")),
        ("Line 4, May\nq1[rad];x[mm];t[s]\n1,5;2,5;1\n", ("line 1, 'Line 4'", "a title", "line 2 has more")),
        ("Line 4;;\n\nIn mm;and;\nq1[rad];x[mm];t[s]\n1;2;1\n", ("line 1, 'Line 4', is a title",)),
        ("Line 4\n1;2,5\n", ("line 1, 'Line 4', is a title", "line 2 has more cells")),
    ],
)
def test_bad_file(tmp_path: Path, text: str, parts: tuple[str, ...]) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_table(path)
    assert all(part in str(caught.value) for part in (f"{path}: ", *parts)) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "cell, shown",
    [("nan", "'nan'"), ("inf", "'inf'"), ("", "is empty"), ("abc", "'abc'"), ("1_0", "'1_0'"), ("1e999", "'inf'")],
)
def test_bad_cell_is_named_when_its_column_is_asked_for(tmp_path: Path, cell: str, shown: str) -> None:
    path = write(tmp_path, f"q1[rad],x[mm]\n1,2\n\n1,{cell}\n3,4\n")
    table = read_table(path)
    np.testing.assert_array_equal(table.column("q1", "rad"), [1.0, 1.0, 3.0])
    with pytest.raises(InputError) as caught:
        table.column("x", "m")
    text = str(caught.value)
    assert f"{path}: column 'x'" in text and "line 4 (row 2)" in text and shown in text


def test_further_bad_cells_are_counted(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "x[mm]\n1\nnan\nnan\nfoo\n"))
    with pytest.raises(InputError, match=r"lines 3, 4 \(rows 2, 3\), and 1 more of its cells is not"):
        table.column("x")


def test_missing_column_names_the_nearest(tmp_path: Path) -> None:
    table = read_table(write(tmp_path, "Q1[rad],temprature[degC]\n1,2\n"))
    with pytest.raises(InputError, match="no column 'q1'; 'Q1' is the nearest"):
        table.column("q1", "rad")
    with pytest.raises(InputError, match="no column 'temperature'; 'temprature' is the nearest"):
        table.column("temperature", "K")
    with pytest.raises(InputError, match=r"no column 'x'; write 'x\[m\]' or 'x\[mm\]'"):
        table.column("x", "m")


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.csv: there is no such file; give the path"):
        read_table(tmp_path / "nowhere.csv")
    with pytest.raises(InputError, match="is a folder and no file"):
        read_table(tmp_path)
    for data in (b"PK\3\4\0\0", "q1[deg]\n1\n".encode("utf-16-le")):
        (tmp_path / "b.csv").write_bytes(data)
        with pytest.raises(InputError, match="no text file; save it as CSV"):
            read_table(tmp_path / "b.csv")
    (tmp_path / "b.csv").write_bytes(b"q1[deg],x\n1,\x81\n")
    with pytest.raises(InputError, match="neither UTF-8 nor UTF-16 nor Windows-1252"):
        read_table(tmp_path / "b.csv")


def test_write_refuses_what_could_not_be_read_back(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="column 'x' would occur twice"):
        write_table(tmp_path / "t.csv", {"x[mm]": [1.0], "x[m]": [1.0]})
    with pytest.raises(InputError, match="one length"):
        write_table(tmp_path / "t.csv", {"x[mm]": [1.0], "y[mm]": [1.0, 2.0]})
    with pytest.raises(InputError, match="cannot be written"):
        write_table(tmp_path / "none" / "t.csv", {"x[mm]": [1.0]})
    assert list(tmp_path.iterdir()) == []


def test_a_missing_value_is_an_empty_cell(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    write_table(path, {"q1[m]": [1.0, 2.0], "note": [np.nan, 3.0]})
    assert path.read_text() == "q1[m],note\n1,\n2,3\n"
    np.testing.assert_array_equal(read_table(path).raw("note"), [np.nan, 3.0])


def test_ten_thousand_rows_are_quick(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(10_000, 30))
    write_table(tmp_path / "t.csv", {f"c{k}[1]": column for k, column in enumerate(values.T)})
    start = time.process_time()
    table = read_table(tmp_path / "t.csv")
    columns = [table.column(name, "1") for name in table.names]
    assert time.process_time() - start < 0.5
    np.testing.assert_array_equal(np.stack(columns, 1), values)
