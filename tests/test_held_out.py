"""`split.test=FILE` and `split.kind=column` from a config to results, and the ways in which commands take records."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from test_geometry_run import tripod_records

from ccnn_torch import calibrate, diagnose, identify, load_mechanism, load_records
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import IDENTIFY
from ccnn_torch.records import read_table, write_table
from ccnn_torch.report.json_files import plain

Cli = Callable[..., tuple[int, str, str]]
NAMES = {"J1": "q1[m]", "J2": "q2[m]", "J3": "q3[m]", "Y": "y[m]", "Z": "z[m]", "Winkel": "phi[rad]"}
HEADERS = ["q1[m]", "q2[m]", "q3[m]", "y[m]", "z[m]", "phi[rad]"]
QUICK = {"methods": ["constant"], "mechanism": "tripod", "geometry": "none", "effects": "none"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """160 rows of a tripod, whole with a column `set`, and as three files under other names."""
    path = tmp_path_factory.mktemp("rows")
    tripod_records(path / "whole.csv")
    table = read_table(path / "whole.csv")
    columns = {table.header(name): table.raw(name) for name in table.names}
    parts = {"day1": slice(0, 60), "day2": slice(60, 120), "later": slice(120, 160)}
    for name, rows in parts.items():
        write_table(path / f"{name}.csv", dict(zip(NAMES, (columns[h][rows] for h in HEADERS), strict=True)))
    write_table(path / "whole.csv", columns | {"set[1]": np.repeat([0.0, 1.0, 2.0], [60, 60, 40])})
    columns_text = "\n".join(f'  {key}: "{value}"' for key, value in NAMES.items())
    (path / "run.yaml").write_text(
        "records: [day1.csv, day2.csv]\nmechanism: tripod\nmethods: [constant]\ngeometry: none\neffects: none\n"
        f"repeats: 2\nsplit: {{test: later.csv}}\nsave_models: false\nsave_report: false\ncolumns:\n{columns_text}\n"
    )
    return path


def test_a_file_of_test_rows_from_config_to_results_and_resumed(folder: Path, cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, _, err = cli("run", str(folder / "run.yaml"), f"out={out}", "--quiet")
    assert code == 0, err
    results = json.loads((out / "results.json").read_text())
    assert results["rows"]["test"] == 40 and results["rows"]["train"] + results["rows"]["validation"] == 120
    assert "Held out: all 40 rows of later.csv." in results["notes"]
    before = (out / "results.json").read_bytes()
    (out / "results.json").unlink()
    RUN.resume(out, quiet=True)
    again = json.loads((out / "results.json").read_text())
    assert again["methods"]["constant"]["test"] == json.loads(before)["methods"]["constant"]["test"]
    # The same rows held out by their column, in one file; the test rows are those of every repeat.
    column = {"kind": "column", "by": "set", "test_values": 2}
    found = calibrate(records=str(folder / "whole.csv"), split=column, repeats=2, covariates=[], **QUICK)
    assert plain(found.results.methods["constant"].test) == results["methods"]["constant"]["test"]
    assert "Held out: the 40 rows whose set is 2." in found.results["notes"]
    assert all(torch.equal(s.test, torch.arange(120, 160)) for s in found.prepared.dataset.splits)


@pytest.mark.parametrize("text", ["day1.csv,day2.csv", "[day1.csv, day2.csv]", "['day1.csv','day2.csv']"])
def test_files_on_the_command_line(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.chdir(folder)
    config = RunConfig.from_file("run.yaml", [f"records={text}", "split.test=later.csv"])
    assert config.records == [str(folder / "day1.csv"), str(folder / "day2.csv")]
    assert config.split.test == str(folder / "later.csv")
    assert RunConfig.from_file("run.yaml", ["records=day1.csv", "split.test=0.4"]).records == str(folder / "day1.csv")
    (folder / "a,b.csv").write_text("x")
    assert RunConfig.from_file("run.yaml", ["records=a,b.csv"]).records == str(folder / "a,b.csv")


@pytest.mark.parametrize(
    "keys, parts",
    [
        ({"split": {"test": "day1.csv"}}, ("split.test", "day1.csv is among the records")),
        ({"split": {"test": "nowhere.csv"}}, ("nowhere.csv: there is no such file",)),
        ({"split": {"test": "whole.csv"}}, ("whole.csv has no column 'J1'",)),
        ({"split": {"kind": "block", "test": "later.csv"}}, ("split: kind=block", "split.kind=random or group")),
        ({"split": {"kind": "column", "by": "set"}}, ("split: kind=column needs one column and its values",)),
        ({"split": {"test_values": [1]}}, ("split: test_values have a meaning with split.kind=column",)),
        ({"split": {"kind": "column", "by": "file", "test_values": [5]}}, ("no row has 5 in 'file', which has 0, 1",)),
        ({"records": []}, ("records: must be a file of records or a list",)),
        ({"columns": {"J1": ["q1[m]"]}}, ("columns.J1",)),
    ],
)
def test_what_cannot_be_held_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch, keys: dict[str, Any], parts: tuple[str, ...]
) -> None:
    monkeypatch.chdir(folder)
    base: dict[str, Any] = {"records": ["day1.csv", "day2.csv"], "columns": NAMES, **QUICK}
    with pytest.raises(InputError) as caught:
        calibrate(**{**base, **keys})
    assert all(part in str(caught.value) for part in parts), str(caught.value)


def test_a_case_reads_no_file() -> None:
    for keys in ({"split": {"test": "a.csv"}}, {"columns": {"A": "q1[m]"}}):
        with pytest.raises(InputError, match="a case"):
            RunConfig.from_keys(case="tripod", **keys)
        with pytest.raises(InputError, match="simulated machines read no file"):
            IdentifyConfig.from_keys(mechanism="tripod", simulate={}, **keys)


def test_identify_reads_records_alike(folder: Path, tmp_path: Path) -> None:
    files = [str(folder / name) for name in ("day1.csv", "day2.csv")]
    test = {"test": str(folder / "later.csv")}
    found = identify(mechanism="tripod", records=files, columns=NAMES, split=test, save_report=False)
    assert (found.measured.rows.joints.shape[1], found.measured.test.joints.shape[1]) == (120, 40)
    assert "Held out: all 40 rows of later.csv." in found.results["notes"]
    frame = pd.read_csv(folder / "whole.csv")
    column = {"kind": "column", "by": "set", "test_values": [2]}
    other = identify(mechanism="tripod", records=frame, split=column, refit=False, save_report=False)
    values = [{name: p["value"] for name, p in one.results["parameters"].items()} for one in (found, other)]
    assert values[0] == pytest.approx(values[1], rel=1e-9)
    # A frame's rows stand beside what was found, so that the folder can be gone on with.
    other.save(tmp_path / "out")
    (tmp_path / "out" / "identified.json").unlink()
    IDENTIFY.resume(tmp_path / "out", quiet=True)
    assert json.loads((tmp_path / "out" / "identified.json").read_text())["parameters"] == other.results["parameters"]


def test_frames_and_loaded_records_in_python(folder: Path) -> None:
    frame, tripod = pd.read_csv(folder / "whole.csv"), load_mechanism("tripod")
    records = load_records(folder / "whole.csv", tripod)
    sources: list[Any] = [folder / "whole.csv", frame, records]
    tests = [calibrate(records=source, **QUICK).results["methods"]["constant"]["test"] for source in sources]
    assert tests[1:] == tests[:1] * 2
    with pytest.raises(InputError, match="loaded already"):
        calibrate(records=records, split={"test": str(folder / "later.csv")}, **QUICK)
    verdicts = [diagnose(source, tripod, effects=["geometry"]).verdict for source in (frame, records)]
    assert verdicts[0] == verdicts[1]


def test_check_takes_maps_and_files(folder: Path, cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("columns:\n" + "\n".join(f'  {k}: "{v}"' for k, v in NAMES.items()) + "\n")
    files = ",".join(str(folder / name) for name in ("day1.csv", "day2.csv"))
    given = ["--records", files, "--mechanism", "tripod", "--config", str(tmp_path / "c.yaml")]
    code, out, err = cli("check", *given)
    assert code == 0 and "120 rows" in out, err
    code, _, err = cli("check", "--records", files, "--mechanism", "tripod")
    assert code == 2 and 'columns: {"J1": ' in err
