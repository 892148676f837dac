"""Records as strangers write them: German Excel, other headers, workbooks, several files, pandas frames."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import openpyxl
import pandas as pd
import pytest
from test_records import ROWS, Arm, Slide, slide_columns

from ccnn_torch.errors import InputError
from ccnn_torch.records import Records, Table, load_records, read_table

# y, phi and two joints as a controller's export has them.
NAMES = {"Weg": "q1[mm]", "A1": "q2[deg]", "Y": "y[mm]", "PHI [rad]": "phi[rad]", "Temp [°C]": "temperature[degC]"}
OURS = ("q1[mm]", "q2[deg]", "y[mm]", "phi[rad]", "temperature[degC]")


def write(path: Path, headers: list[str], columns: list[np.ndarray], separator: str = ",", code: str = "utf-8") -> Path:
    rows = [separator.join(headers)]
    for values in zip(*columns, strict=True):
        cells = [value if isinstance(value, str) else repr(float(value)) for value in values]
        rows.append(separator.join(cell.replace(".", ",") if separator == ";" else cell for cell in cells))
    path.write_bytes("\r\n".join([*rows, ""]).encode(code))
    return path


def ours(folder: Path, name: str = "ours.csv", **more: np.ndarray) -> Path:
    columns = slide_columns() | more
    return write(folder / name, list(columns), list(columns.values()))


def german(folder: Path, code: str = "cp1252") -> Path:
    columns = slide_columns()
    headers = [*NAMES, "Bemerkung", "Datum", ""]
    text = [np.array([value] * ROWS) for value in ("größer", "12.03.2024", "")]
    return write(folder / f"{code}.csv", headers, [*(columns[name] for name in OURS), *text], ";", code)


def same(first: Records, second: Records) -> None:
    for name in ("joints", "pose", "covariates"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=1e-14)
    assert first.covariate_coordinates == second.covariate_coordinates


def refused(source: Any, *parts: str, mechanism: Slide | Arm | None = None, **keys: Any) -> str:
    with pytest.raises(InputError) as caught:
        load_records(source, mechanism or Slide(), **keys)
    assert all(part in str(caught.value) for part in parts) and "\n" not in str(caught.value), str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("code", ["cp1252", "utf-8", "utf-8-sig", "utf-16"])
def test_a_german_excel_file_under_its_own_names(tmp_path: Path, code: str) -> None:
    found = load_records(german(tmp_path, code), Slide(), columns=NAMES)
    same(found, load_records(ours(tmp_path), Slide()))
    assert any("code page 1252" in note for note in found.notes) == (code == "cp1252")


def test_the_line_that_excel_names_its_separator_in(tmp_path: Path) -> None:
    path = german(tmp_path)
    path.write_bytes(b"sep=;\r\n" + path.read_bytes())
    same(load_records(path, Slide(), columns=NAMES), load_records(ours(tmp_path), Slide()))


def test_a_point_in_a_text_does_not_hide_decimal_commas_and_one_in_a_number_does(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("x[mm];note;day\n1,5;a.b;12.03.2024\n2;c;13.03.2024\n")
    np.testing.assert_array_equal(read_table(tmp_path / "t.csv").raw("x"), [1.5, 2.0])
    (tmp_path / "t.csv").write_text("x[mm];y[mm]\n1,500;0.5\n2;1\n")
    with pytest.raises(InputError, match="has '1,500' at line 2"):
        read_table(tmp_path / "t.csv").column("x", "m")


def test_a_workbook(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.append(["Report of", 12])
    sheet = book.create_sheet("rows")
    columns = slide_columns()
    sheet.append([None, "# by hand"])
    sheet.append([*columns, "note"])
    for k, row in enumerate(zip(*columns.values(), strict=True)):
        sheet.append([*(value.item() for value in row), "seen" if k % 2 else None])
    book.save(tmp_path / "rows.xlsx")
    found = load_records(tmp_path / "rows.xlsx", Slide())
    same(found, load_records(ours(tmp_path), Slide()))
    assert found.name_rows([0]) == "line 3 (row 1)" and "sheet rows" in found.path
    sheet["B5"] = None
    book.save(tmp_path / "rows.xlsx")
    refused(tmp_path / "rows.xlsx", "column 'q2' is empty at line 5 (row 3)")
    sheet["B5"] = "=1+1"  # never calculated: no value is kept beside the formula
    book.save(tmp_path / "rows.xlsx")
    refused(tmp_path / "rows.xlsx", "column 'q2' is empty at line 5 (row 3)")
    (tmp_path / "no.xlsx").write_bytes(b"q1[mm]\n1\n")
    refused(tmp_path / "no.xlsx", "no workbook that openpyxl can read")
    refused(tmp_path / "nowhere.xlsx", "there is no such file")


def test_what_is_true_is_no_number(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    columns = slide_columns()
    book.active.append(list(columns))
    for row in zip(*columns.values(), strict=True):
        book.active.append([value.item() for value in row])
    book.active["A3"] = True
    book.save(tmp_path / "rows.xlsx")
    refused(tmp_path / "rows.xlsx", "rows.xlsx (sheet Sheet): column 'y' has 'TRUE' at line 3 (row 2)")
    frame = pd.DataFrame({name: list(values) for name, values in columns.items()}, dtype=object)
    frame.iloc[1, 0] = True
    refused(frame, "DataFrame: column 'y' has 'TRUE' at line 3 (row 2)")


def test_a_workbook_that_is_packed_too_densely_is_not_unpacked(tmp_path: Path) -> None:
    with ZipFile(tmp_path / "rows.xlsx", "w", ZIP_DEFLATED) as book:
        book.writestr("xl/worksheets/sheet1.xml", b"<row/>" * 5_000_000)
    refused(tmp_path / "rows.xlsx", "has 30 MB unpacked, mostly of cells that are empty or alike")


def test_a_workbook_without_openpyxl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    refused(tmp_path / "rows.xlsx", "needs openpyxl", "pip install 'ccnn-torch[excel]'")


@pytest.mark.parametrize(
    "columns, parts",
    [
        ({"Wegg": "q1[mm]"}, ("has no column 'Wegg'", "did you mean 'Weg'")),
        ({"Weg": "q1"}, ("'q1' for 'Weg' has no unit", "q1[mm]")),
        ({"Weg": "q1[fuß]"}, ("column 'q1'", "'fuß' is not known")),
        ({"Weg": "q1[mm"}, ("not of the form name[unit]",)),
        ({"Temp [°C]": "temperature[K]"}, ("is in K", "in °C")),
        ({"Weg": "q1[mm]", "A1": "q1[deg]"}, ("'Weg' and 'A1' would both be the column 'q1'", "ignore")),
        ({"Temp": "q1[mm]", "Temp [°C]": "q2[deg]"}, ("'Temp [°C]'", "named twice")),
    ],
)
def test_a_map_that_does_not_fit(tmp_path: Path, columns: dict[str, str], parts: tuple[str, ...]) -> None:
    refused(german(tmp_path), *parts, columns=columns)


def test_the_unit_may_stand_in_the_file_and_a_name_do_for_its_header(tmp_path: Path) -> None:
    short = NAMES | {"PHI [rad]": "phi", "Temp [°C]": "temperature"}
    short["PHI"] = short.pop("PHI [rad]")
    short["Temp[°C]"] = short.pop("Temp [°C]")
    same(load_records(german(tmp_path), Slide(), columns=short), load_records(ours(tmp_path), Slide()))


def test_headers_in_parentheses(tmp_path: Path) -> None:
    columns = slide_columns()
    headers = [name.replace("[", " (").replace("]", ")") for name in OURS]
    path = write(tmp_path / "p.csv", [*headers, "probe (1)"], [*(columns[n] for n in OURS), np.ones(ROWS)])
    same(load_records(path, Slide()), load_records(ours(tmp_path), Slide()))
    assert read_table(path).units["probe (1)"] == ""


def test_only_a_column_that_is_used_needs_a_unit(tmp_path: Path) -> None:
    columns = slide_columns()
    bare = {("row" if name == "row[1]" else name): values for name, values in columns.items()} | {"set": np.ones(ROWS)}
    path = write(tmp_path / "bare.csv", list(bare), list(bare.values()))
    found = load_records(path, Slide())
    same(found, load_records(ours(tmp_path), Slide()))
    np.testing.assert_array_equal(found.columns["row"], np.arange(ROWS))
    refused(path, "column 'row' has no unit", covariates=["row"])
    for old, new, hint in (("q1[mm]", "q1", "'q1[m]'"), ("y[mm]", "y", "'y[mm]'"), ("temperature[degC]",) * 2 + ("",)):
        header = [new.partition("[")[0] if name == old else name for name in bare]
        refused(write(tmp_path / "b.csv", header, list(bare.values())), f"'{new.partition('[')[0]}' has no unit", hint)


def test_joints_under_other_names_get_the_map_to_write(tmp_path: Path) -> None:
    columns = slide_columns()
    headers = [{"q1[mm]": "J1", "q2[deg]": "Joint_2 [deg]"}.get(name, name) for name in columns]
    path = write(tmp_path / "j.csv", headers, list(columns.values()))
    refused(path, "no column 'q1'", 'columns: {"J1": "q1[mm]", "Joint_2[deg]": "q2[deg]"}')
    same(
        load_records(path, Slide(), columns={"J1": "q1[mm]", "Joint_2": "q2[deg]"}),
        load_records(ours(tmp_path), Slide()),
    )
    found = load_records(ours(tmp_path, **{"axis_3[deg]": np.ones(ROWS)}), Slide())
    assert any("axis_3 look like joints and are not used" in note for note in found.notes)


def test_several_files_are_one_and_rows_are_named_by_file(tmp_path: Path) -> None:
    columns = slide_columns()
    first = write(tmp_path / "day1.csv", list(columns), [v[:5] for v in columns.values()])
    turned = dict(reversed(columns.items()))
    second = write(tmp_path / "day2.csv", list(turned), [v[5:] for v in turned.values()])
    found = load_records([first, second], Slide())
    same(found, load_records(ours(tmp_path), Slide()))
    np.testing.assert_array_equal(found.columns["file"], [0] * 5 + [1] * (ROWS - 5))
    assert not any("file" in note for note in found.notes)
    assert found.name_rows([4]) == f"line 6 (row 5) of {first}"
    assert found.name_rows([4, 5, 6]) == f"line 6 (row 5) of {first} and lines 2, 3 (rows 1, 2) of {second}"
    values = [v[5:].copy() for v in turned.values()]
    values[list(turned).index("y[mm]")][2] = np.nan
    write(second, list(turned), values)
    refused([first, second], "column 'y' has 'nan' at line 4 (row 3) of ", "day2.csv")


def test_files_that_differ_are_refused(tmp_path: Path) -> None:
    first = ours(tmp_path, "a.csv")
    refused([first, ours(tmp_path, "b.csv", **{"wear[1]": np.ones(ROWS)})], "a.csv: there is no column 'wear', which")
    columns = {name.replace("y[mm]", "y[m]"): values for name, values in slide_columns().items()}
    refused(
        [first, write(tmp_path / "c.csv", list(columns), list(columns.values()))], "c.csv: column 'y' is in m", "mm"
    )
    own = {"file[1]": np.arange(ROWS)}
    found = load_records([ours(tmp_path, "a.csv", **own), ours(tmp_path, "b.csv", **own)], Slide())
    np.testing.assert_array_equal(found.columns["file"], [*range(ROWS)] * 2)
    assert any("'file' of their own" in note for note in found.notes)
    refused([], "empty list")


def test_a_frame_and_loaded_records(tmp_path: Path) -> None:
    frame = pd.DataFrame(slide_columns())
    from_file = load_records(ours(tmp_path), Slide())
    same(load_records(frame, Slide()), from_file)
    assert load_records(from_file, Slide()) is from_file
    refused(from_file, "loaded already", covariates=["row"])
    refused(from_file, "joints q1, q2", mechanism=Arm(joints=Arm().joints[:1]))
    frame["note"] = pd.array([None, "a"] * (ROWS // 2), dtype="string")
    frame["y[mm]"] = frame["y[mm]"].astype("Float64")
    same(load_records([frame.iloc[:5], frame.iloc[5:]], Slide()), from_file)
    frame["q1[mm]"] = frame["q1[mm]"].astype("Float64")
    frame.loc[2, "q1[mm]"] = pd.NA
    refused(frame, "DataFrame: column 'q1' is empty at line 4 (row 3)")
    refused(frame.iloc[:0], "no row")
    refused(7, "a int holds none")


def test_table_keeps_what_its_map_keeps(tmp_path: Path) -> None:
    table: Table = read_table(german(tmp_path), {"Datum": "ignore", "Bemerkung": "ignore", "Weg": "q1[mm]"})
    assert table.names == ("q1", "A1", "Y", "PHI", "Temp", "column 8")
    assert table.header("A1") == "A1" and table.header("q1") == "q1[mm]"


def test_thousands_and_a_row_that_breaks_off_are_told_as_such(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("q1[mm],q2[deg],y[mm],phi[rad]\n" + '"1,234.5",0.2,0.3,0.4\n' * 9)
    refused(path, "write numbers without thousands separators")
    # Commas that are decimal ones beside numbers with points, and quoted where they stand between cells as well.
    path.write_text('"q1[rad]","x[m]"\n"0,8","1.5"\n"0.7","1.4"\n')
    refused(path, "write its decimal comma as a point (0.8)")
    path.write_text("q1[mm],q2[deg],y[mm],phi[rad]\n" + "0.1,0.2,0.3,0.4\n" * 9 + "0.1,0.")
    assert "semicolons" not in refused(path, "has 2 cells")
