"""`ccnn compare` and `ccnn keys`: runs side by side, keys by section, and the schema of configs."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML

from ccnn_torch.config.keys import config_schema, keys_by_section

Cli = Callable[..., tuple[int, str, str]]
EXPERIMENTS = Path(__file__).parent.parent / "experiments"
QUICK = ["methods=[constant,grnn]", "save_models=false", "save_report=false", "grnn.iterations=2"]


def tripod(folder: Path, cli: Cli, *keys: str) -> Path:
    code, _, err = cli("run", EXPERIMENTS / "tripod.yaml", *QUICK, "repeats=1", *keys, "--out", folder, "--quiet")
    assert code == 0, err
    return folder


def test_runs_of_the_same_rows_share_a_letter(tmp_path: Path, cli: Cli) -> None:
    runs = [tripod(tmp_path / "one", cli), tripod(tmp_path / "two", cli, "methods=[constant]"),
            tripod(tmp_path / "three", cli, "split.test=0.4", "methods=[constant]")]  # fmt: skip
    code, out, err = cli("compare", *runs, "--out", tmp_path / "runs.csv")
    assert code == 0, err
    assert "not comparable" in " ".join(out.split())
    with (tmp_path / "runs.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    results = json.loads((runs[0] / "results.json").read_text())
    first = next(row for row in rows if row["run"] == str(runs[0]) and row["best"] == "1")
    assert first["method"] == results["best_method"]
    assert float(first["after"]) == results["pose"]["position"]["after"]["rms"]["median"]
    assert len([row for row in rows if row["run"] == str(runs[0]) and row["quantity"] == "position_rms"]) == 2
    assert cli("compare", *runs[:2], "--out", tmp_path / "runs.md", "--quiet")[0] == 0
    table = (tmp_path / "runs.md").read_text()
    assert table.count("| A |") == 2 and "not comparable" not in table


def test_a_name_is_no_formula_of_a_spreadsheet(tmp_path: Path, cli: Cli) -> None:
    run = tripod(tmp_path / "run", cli, "methods=[constant]", "name==1+1")
    assert cli("compare", run, "--out", tmp_path / "runs.csv", "--quiet")[0] == 0
    with (tmp_path / "runs.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows} == {"'=1+1"} and all(float(row["before"]) > 0 for row in rows)


def test_what_cannot_be_compared(tmp_path: Path, cli: Cli) -> None:
    code, _, err = cli("compare", tmp_path)
    assert code == 2 and "results.json" in err
    (tmp_path / "results.json").write_text("{}")
    code, _, err = cli("compare", tmp_path)
    assert code == 2 and "is no results.json of this version" in err


def test_keys_stand_by_section(cli: Cli) -> None:
    code, out, _ = cli("keys")
    assert code == 0 and out.startswith("# top level\n") and "\n\n# ccnn\nccnn." in out
    assert next(iter(keys_by_section("run"))) == ""
    assert "parameters." in cli("keys", "identify")[1]


@pytest.mark.parametrize("command", ["run", "identify", "suite", "plan", "diagnose"])
def test_every_command_has_a_schema(command: str, cli: Cli) -> None:
    code, out, _ = cli("keys", command, "--schema")
    assert code == 0
    jsonschema.Draft202012Validator.check_schema(json.loads(out))


@pytest.mark.parametrize(
    ("name", "command"),
    [("tripod", "run"), ("machine_tool", "run"), ("ur10", "run"), ("records", "run"), ("realistic", "suite"),
     ("five_bar", "identify"), ("overconstrained_2dof", "identify"), ("sockets", "identify")],
)  # fmt: skip
def test_shipped_configs_fit_the_schema(name: str, command: str) -> None:
    tree = YAML(typ="safe", pure=True).load((EXPERIMENTS / f"{name}.yaml").read_text(encoding="utf-8"))
    jsonschema.validate(tree, config_schema(command))
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**tree, "sede": 1}, config_schema(command))


def test_texts_that_stand_for_lists_fit_the_schema() -> None:
    tree = {"case": "tripod", "methods": "all", "split": {"test": 0.2, "by": "position:5mm"}}
    jsonschema.validate(tree | {"compensation": {"limit": 1e-3}}, config_schema("run"))
    assert config_schema("run")["$defs"]["CCNNSettings"]["properties"]["generations"]["description"]


def test_the_shell_completes_commands() -> None:
    words = {"COMP_WORDS": "ccnn ver", "COMP_CWORD": "1"}
    code = "import sys; sys.argv = ['ccnn']; from ccnn_torch.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False,
        env={"PATH": "", "PYTHONPATH": str(EXPERIMENTS.parent), "_CCNN_COMPLETE": "complete_bash", **words},
    )  # fmt: skip
    assert done.stdout.split() == ["verify"], done.stderr
