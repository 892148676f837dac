"""Files that nobody here made: one sentence and exit code 2, whatever stands in them."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import parse_json, read_bytes
from ccnn_torch.files.yaml_file import dump_yaml, parse_yaml
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, write_table

Cli = Callable[..., tuple[int, str, str]]

YAMLS = {
    "an anchor that refers to itself": "name: &a [*a]",
    "a billion laughs": "a: &a [lol, lol]\n"
    + "".join(f"{c}: &{c} [*{b}, *{b}]\n" for b, c in zip("abcdefgh", "bcdefghi", strict=True)),
    "merged maps": "a: &a {x: 1}\nb: {<<: *a}",
    "a list as key": "? [1, 2]\n: 3",
    "a map as key": "? {a: 1}\n: 3",
    "nothing as key": "seed: 1\n~: 2",
    "open brackets": "ccnn: " + "[" * 1000,
    "brackets": "ccnn: " + "[" * 1000 + "]" * 1000,
    "deep blocks": "".join(" " * i + "a:\n" for i in range(50)),
    "a key that stands twice": "seed: 1\nseed: 2",
    "two documents": "seed: 1\n---\nseed: 2",
    "a tab": "ccnn:\n\tseed: 1",
    "NUL": "name: \0",
    "NUL, escaped": 'name: "\\0"',
    "half of a pair": 'name: "\\ud800"',
    "a character that there is not": 'name: "\\UFFFFFFFF"',
    "an object": "name: !!python/object/apply:os.system [echo]",
    "a tag": "name: !x y",
    "a set": "name: !!set {x, y}",
    "a day that there is not": "name: 2024-13-45",
    "a date": "case: 2024-01-01",
    "a date in a list": "case: tripod\nccnn: [2024-01-01]",
    "too large a number": "case: tripod\nrotation_weight: 1e999",
    "too long a number": "case: tripod\nrotation_weight: 1" + "0" * 400,
    "too many digits": "case: tripod\nseed: " + "9" * 5000,
    "a seed beyond all generators": "case: tripod\nseed: 123456789012345678901234567890",
    "a list": "- 1\n- 2",
    "a directive": "%YAML 9.9\n---\nseed: 1",
    "an escape sequence in a key": '"\\e[31mred": 1\ncase: tripod',
}


def told(outcome: tuple[int, str, str]) -> str:
    """The one sentence, which a terminal can show."""
    code, _, err = outcome
    assert code == 2, err
    assert err.count("\n") == 1 and "Traceback" not in err, err
    assert all(c.isprintable() for c in err[:-1]), repr(err)
    assert len(err) < 2200
    return err


@pytest.mark.parametrize(
    ("command", "case"), [*(("run", case) for case in YAMLS), *((c, "a set") for c in ("identify", "suite"))]
)
def test_configs(case: str, command: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "c.yaml").write_text(YAMLS[case], encoding="utf-8")
    assert "c.yaml" in told(cli(command, tmp_path / "c.yaml", f"out={tmp_path / 'out'}"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", YAMLS)
def test_arms_and_plans(case: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "arm.yaml").write_text(YAMLS[case], encoding="utf-8")
    assert "arm.yaml" in told(
        cli("plan", "--mechanism", tmp_path / "arm.yaml", "--poses", "9", "--out", tmp_path / "p.csv")
    )


def test_yaml_in_other_encodings(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "c.yaml").write_bytes("case: tripod\nname: é".encode("latin-1"))
    assert "line 2" in told(cli("run", tmp_path / "c.yaml"))
    (tmp_path / "c.yaml").write_bytes("case: tripod".encode("utf-16"))
    assert "UTF-8" in told(cli("run", tmp_path / "c.yaml"))
    (tmp_path / "c.yaml").write_text("#" * 1_100_000)
    assert "1 MB" in told(cli("run", tmp_path / "c.yaml"))


def test_who_changes_what_was_read_changes_it_for_nobody_else() -> None:
    first = parse_yaml("a: {b: [1, 2]}", "text")
    first["a"]["b"].append(3)
    assert parse_yaml("a: {b: [1, 2]}", "text") == {"a": {"b": [1, 2]}}


def test_what_stands_twice_is_written_twice() -> None:
    shared = [1, 2]
    assert parse_yaml(dump_yaml({"a": shared, "b": shared}), "dump") == {"a": [1, 2], "b": [1, 2]}


ARM = (
    '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
    '<child link="b"/>{}</joint></robot>'
)
LAUGHS = (
    '<!DOCTYPE r [<!ENTITY a "lol">'
    + "".join(
        f'<!ENTITY {c} "&{b};&{b};&{b};&{b};&{b};&{b};&{b};&{b};&{b};">'
        for b, c in zip("abcdefghi", "bcdefghij", strict=True)
    )
    + "]>"
)
URDFS: dict[str, bytes] = {
    "empty": b"",
    "no XML": b"\x00\xff\xfe",
    "UTF-16 declared as UTF-8": ('<?xml version="1.0" encoding="utf-8"?>' + ARM.format("")).encode("utf-16-le"),
    "Latin-1 declared as UTF-8": (
        '<?xml version="1.0" encoding="utf-8"?>' + ARM.format("").replace('"r"', '"é"')
    ).encode("latin-1"),
    "an encoding that there is not": b'<?xml version="1.0" encoding="klingon"?><robot/>',
    "an encoding of several bytes": b'<?xml version="1.0" encoding="shift_jis"?><robot/>',
    "a billion laughs": (LAUGHS + ARM.format("&j;")).encode(),
    "another file": b'<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
    "no number": ARM.format('<origin xyz="nan 0 0"/>').encode(),
    "infinite": ARM.format('<origin xyz="1e999 0 0"/>').encode(),
    "larger than the earth": ARM.format('<origin xyz="1e200 0 0"/>').encode(),
    "limits that are none": ARM.format('<limit lower="nan" upper="1"/>').encode(),
    "limits the wrong way round": ARM.format('<limit lower="1" upper="-1"/>').encode(),
    "no axis": ARM.format('<axis xyz="0 0 0"/>').encode(),
    "no child": b'<robot><link name="a"/><joint name="j" type="fixed"><parent link="a"/></joint></robot>',
    "no name": b"<robot><joint/></robot>",
    "a loop": (
        '<robot><link name="a"/><link name="b"/><link name="t"/>'
        + "".join(
            f'<joint name="{p}{c}" type="revolute"><parent link="{p}"/><child link="{c}"/></joint>'
            for p, c in ("ab", "ba", "bt")
        )
        + "</robot>"
    ).encode(),
    "two parents": (
        '<robot><link name="a"/><link name="b"/><link name="t"/>'
        + "".join(
            f'<joint name="{p}{c}" type="revolute"><parent link="{p}"/><child link="{c}"/></joint>'
            for p, c in ("at", "bt")
        )
        + "</robot>"
    ).encode(),
    "twenty thousand joints": (
        "<robot>"
        + "".join(
            f'<link name="l{i}"/><joint name="j" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
            for i in range(20_000)
        )
        + '<link name="l20000"/></robot>'
    ).encode(),
}


@pytest.mark.parametrize("case", URDFS)
def test_urdfs(case: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "arm.urdf").write_bytes(URDFS[case])
    told(cli("plan", "--mechanism", tmp_path / "arm.urdf", "--poses", "9", "--out", tmp_path / "p.csv"))


@pytest.mark.parametrize("dof", ["1e9", "-1", "2.5", "1e999", "true", "100000000"])
def test_joints_of_an_arm_are_few(dof: str, tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(
        f"dof: {dof}\nconvention: standard Denavit-Hartenberg\nunits: {{length: m, angle: rad}}\n"
    )
    with pytest.raises(InputError, match="dof"):
        load_mechanism(str(tmp_path / "arm.yaml"))


def no_file(kind: str, folder: Path) -> Path:
    path = folder / "x.yaml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "socket":
        # A socket's path may have 107 characters, fewer than a test's folder.
        here = os.getcwd()
        os.chdir(folder)
        with socket.socket(socket.AF_UNIX) as made:
            made.bind("x.yaml")
        os.chdir(here)
    return path


@pytest.mark.parametrize("kind", ["pipe", "folder", "loop", "device", "socket", "nothing"])
def test_what_is_no_file(kind: str, tmp_path: Path, cli: Cli) -> None:
    path = no_file(kind, tmp_path)
    for words in (
        ("run", path),
        ("check", "--records", path, "--mechanism", "tripod"),
        ("plan", "--mechanism", path, "--poses", "9", "--out", tmp_path / "p.csv"),
        ("compensate", path, path, tmp_path / "o.csv"),
        ("run", "case=tripod", f"records={path}"),
    ):
        told(cli(*words))
    with pytest.raises(InputError):
        read_bytes(path, 10)


def test_a_path_with_nul() -> None:
    with pytest.raises(InputError, match="is no path"):
        read_bytes("a\0b", 10)


def test_output_in_a_loop_of_links(tmp_path: Path, cli: Cli) -> None:
    no_file("loop", tmp_path)
    told(cli("compensate", tmp_path / "m.onnx", tmp_path / "x.yaml", tmp_path / "x.yaml"))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": NaN}', '{"a": 1, "a": 2}', "{", "\ufeff{}", "", '{"a": 1e5,}'])
def test_json(text: str) -> None:
    with pytest.raises(InputError, match=r"file\.json: "):
        parse_json(text, "file.json")


@pytest.mark.parametrize(
    "value",
    [None, [], "x", 3, {"verdict": 1}, {"verdict": {"effects": "a", "outside_library": 0, "none": 0}, "effects": [1]}],
)
def test_a_diagnosis_of_others(value: object, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "diagnosis.json").write_text(json.dumps(value))
    write_table(tmp_path / "r.csv", {"q1[m]": [0.0, 1.0]})
    found = cli("run", _config(tmp_path, effects=f"from:{tmp_path / 'diagnosis.json'}"))
    assert "diagnosis.json" in told(found)


def _config(folder: Path, **keys: str) -> Path:
    (folder / "c.yaml").write_text(
        "".join(f"{k}: {v}\n" for k, v in {"records": "r.csv", "mechanism": "tripod", **keys}.items())
    )
    return folder / "c.yaml"


HEADERS = {
    "=1+1[mm]": "formula",
    "+x[mm]": "formula",
    "-x[mm]": "formula",
    "@x[mm]": "formula",
    "x\x1b[31m[mm]": "control character",
    "x\u202egnp[mm]": "control character",
    "x" * 12_000 + "[mm]": "characters",
}


@pytest.mark.parametrize("header", HEADERS)
def test_headers(header: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "r.csv").write_text(f"q1[mm],{header}\n1,2\n")
    with pytest.raises(InputError, match=HEADERS[header]):
        read_table(tmp_path / "r.csv")
    said = told(cli("check", "--records", tmp_path / "r.csv", "--mechanism", "tripod"))
    assert "column 2" in said and len(said) < 400


def test_a_cell_is_quoted_as_text_that_can_be_shown(tmp_path: Path, cli: Cli) -> None:
    names = ["q1[m]", "q2[m]", "q3[m]", "y[m]", "z[m]", "phi[rad]"]
    (tmp_path / "r.csv").write_text(",".join(names) + "\n\x1b[31m" + "x" * 5000 + ",1,1,1,1,1\n")
    assert "\\x1b[31m" in told(cli("check", "--records", tmp_path / "r.csv", "--mechanism", "tripod"))


def test_a_quote_that_is_not_closed_takes_no_other_rows(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text('a[1],b[1]\n"1,2\n3,4\n')
    with pytest.raises(InputError, match="line 2 "):
        read_table(tmp_path / "r.csv")


def test_visible() -> None:
    assert visible("a\x1b[2J\u202eb\ud800 é") == "a\\x1b[2J\\u202eb\\ud800 é"
    assert len(visible("x" * 9999)) < 210


@pytest.mark.parametrize("cell", ["1e155", "1e11"])
@pytest.mark.parametrize("column", ["q1[rad]", "temperature[K]", "load_x[N]"])
def test_a_cell_beyond_all_that_is_measured(column: str, cell: str, tmp_path: Path, cli: Cli) -> None:
    rows = five_bar_rows()
    rows[column] = [cell if i == 40 else v for i, v in enumerate(rows[column])]
    path = write_text_table(tmp_path / "r.csv", rows)
    said = told(cli("check", "--records", path, "--mechanism", "five_bar"))
    assert "line 42 (row 41)" in said or "looks like degrees" in said


@pytest.mark.parametrize("column", ["temperature[K]", "load_x[N]"])
def test_numbers_next_to_nothing(column: str, tmp_path: Path, cli: Cli) -> None:
    rows = five_bar_rows()
    rows[column] = [repr(i * 5e-324) for i in range(len(rows[column]))]
    path = write_text_table(tmp_path / "r.csv", rows)
    code, out, err = cli("check", "--records", path, "--mechanism", "five_bar")
    assert (code == 2 or "nan" not in out) and "Traceback" not in err


def test_joints_without_a_pose_are_named_before_an_identification(tmp_path: Path, cli: Cli) -> None:
    rows = five_bar_rows()
    rows["q2[rad]"] = ["0" if i == 40 else v for i, v in enumerate(rows["q2[rad]"])]
    write_text_table(tmp_path / "r.csv", rows)
    assert "line 42 (row 41)" in told(cli("identify", _config(tmp_path, mechanism="five_bar"), f"out={tmp_path / 'o'}"))


def five_bar_rows(count: int = 60) -> dict[str, list[str]]:
    machine = load_mechanism("five_bar")
    pose = machine.sample_workspace(count, torch.Generator().manual_seed(0))
    joints = machine.solve_inverse(pose)
    noise = torch.randn(count, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    reached = machine.forward_kinematics(joints + 1e-4, guess=pose) + 1e-6 * noise[:, :2]
    values = {"q1[rad]": joints[:, 0], "q2[rad]": joints[:, 1], "x[m]": reached[:, 0], "y[m]": reached[:, 1]}
    values |= {"temperature[K]": 300 + noise[:, 2], "load_x[N]": 5 * noise[:, 3], "direction1[1]": noise[:, 4].sign()}
    return {name: [repr(v) for v in column.tolist()] for name, column in values.items()}


def write_text_table(path: Path, columns: dict[str, list[str]]) -> Path:
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(row) for row in rows)]) + "\n")
    return path


@pytest.mark.parametrize("keys", [["repeats=10000000"], ["case=realistic", "order=null", "realistic.rows=2000000000"]])
def test_more_than_the_memory_holds(keys: list[str], tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "c.yaml").write_text("case: tripod\n")
    said = told(cli("run", tmp_path / "c.yaml", *keys, f"out={tmp_path / 'out'}"))
    assert "GB" in said and "repeats" in said


def test_a_run_that_is_moved_with_its_data(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    write_text_table(here / "r.csv", five_bar_rows())
    config = _config(here, mechanism="five_bar", methods="constant")
    code, _, err = cli(
        "run", config, f"out={here / 'run'}", "geometry=none", "effects=none", "save_models=false", "--quiet"
    )
    assert code == 0, err
    code, _, err = cli("identify", config, "methods=lm", f"out={here / 'found'}", "--quiet")
    assert code == 0, err
    named = [path for path in here.rglob("*") if path.is_file() and str(tmp_path).encode() in path.read_bytes()]
    assert named == []
    here.rename(there)
    monkeypatch.chdir("/")
    before = (there / "run" / "results.csv").read_bytes()
    (there / "run" / "results.json").unlink()
    (there / "found" / "identified.json").unlink()
    code, _, err = cli("run", "--resume", there / "run", "--quiet")
    assert code == 0, err
    assert (there / "run" / "results.csv").read_bytes().split(b"seconds")[0] == before.split(b"seconds")[0]
    code, _, err = cli("identify", "--resume", there / "found", "--quiet")
    assert code == 0, err


def test_brackets_are_shown_on_the_screen() -> None:
    from rich.console import Console

    from ccnn_torch.report.table import Table, print_table, print_text

    screen = Console(width=80, force_terminal=True, record=True)
    print_text("a note [t] in [bold]brackets[/bold] \x1b[2J", screen, "dim")
    print_table(Table("title [t]", ("name [t]", "a"), (("row [red]", "1 [2, 3]"),), "below [/t]"), screen)
    shown = screen.export_text()
    for text in ("note [t] in [bold]brackets[/bold] \\x1b[2J", "title [t]", "[t]", "row [red]", "[2, 3]", "[/t]"):
        assert text in shown
