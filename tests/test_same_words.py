"""One config and the same options for every command that reads records."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from ccnn_torch.diagnosis.config import DiagnoseConfig
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.planning.config import PlanConfig
from ccnn_torch.records import read_table
from ccnn_torch.verification.job import VerifyConfig

Cli = Callable[..., tuple[int, str, str]]
QUICK = ("methods=[constant]", "geometry=none", "effects=none", "save_models=false", "save_report=false")
PLANNED = ("candidates=300", "--quiet", "--poses", 8, "--out")


@pytest.fixture
def config(tmp_path: Path, cli: Cli) -> Path:
    """What `ccnn new` writes for rows of a five-bar under other headers."""
    assert cli("simulate", "--mechanism", "five_bar", "--effect", "geometry", "--rows", 60, "--noise", "1e-5",
               "--out", tmp_path / "rows.csv", "--quiet")[0] == 0  # fmt: skip
    rows = tmp_path / "rows.csv"
    names, _, below = rows.read_text().partition("\n")
    rows.write_text(names.replace("q1[rad]", "J1").replace("q2[rad]", "J2").replace("x[", "X[") + "\n" + below)
    out = tmp_path / "robot.yaml"
    new = cli("new", rows, "--mechanism", "five_bar", "--units", "m,rad", "--out", out)
    assert new[0] == 0, new
    return out


def test_the_config_of_new_goes_into_every_command(config: Path, tmp_path: Path, cli: Cli) -> None:
    for words in (
        ("check", config),
        ("check", "--config", config, "--quiet"),
        ("diagnose", config, "--out", tmp_path / "d", "--no-network", "effects=[geometry]"),
        ("identify", "--config", config, f"--out={tmp_path / 'i'}", "save_report=false"),
        ("run", "--config", config, "--out", tmp_path / "r", *QUICK, "--quiet"),
        ("plan", config, *PLANNED, tmp_path / "p.csv"),
        ("plan", "--config", config, "--records", tmp_path / "rows.csv", *PLANNED, tmp_path / "p.csv"),
        ("verify", tmp_path / "i" / "identified.yaml", "--config", config, "--out", tmp_path / "v"),
    ):
        code, out, err = cli(*words)
        assert code in ((0, 1) if words[0] == "verify" else (0,)), (words, out, err)
        # How ccnn run splits the rows is nothing that a user of the others has to be told.
        assert "not used here" not in out, (words, out)


def test_options_stand_for_keys(config: Path, tmp_path: Path, cli: Cli) -> None:
    rows = tmp_path / "rows.csv"
    table = read_table(rows)
    assert "J1" in table
    code, _, err = cli("identify", "--records", rows, "--mechanism", "five_bar", "--out", tmp_path / "i", "--quiet")
    assert code == 2 and "there is no column 'q1'" in err
    columns = 'columns={J1: "q1[rad]", J2: "q2[rad]", X: "x[m]"}'
    options = ("--records", rows, "--mechanism", "five_bar", "--out", tmp_path / "i", "--quiet")
    assert cli("identify", columns, *options)[0] == 0
    assert cli("run", columns, *QUICK, *options[:-2], tmp_path / "r", "--quiet")[0] == 0
    model = tmp_path / "i" / "identified.yaml"
    assert cli("verify", model, "--records", rows, "--out", tmp_path / "v", "--quiet")[0] in (0, 1)
    for words, sentence in (
        (("verify", model, "--out", tmp_path / "v"), "records: are missing; give RECORDS.csv, --records"),
        (("plan", "--poses", 3, "--out", tmp_path / "p.csv"), "mechanism: is missing; give --mechanism"),
        (("check", config, "--config", config), "two configs are given"),
    ):
        code, _, err = cli(*words)
        assert code == 2 and sentence in err and err.count("\n") == 1


@pytest.mark.parametrize(
    "load", [DiagnoseConfig.from_file, IdentifyConfig.from_file, PlanConfig.from_file, VerifyConfig.from_file]
)
def test_what_no_command_knows_is_refused_with_the_nearest_key(
    load: Callable[..., object], config: Path, tmp_path: Path
) -> None:
    notes: list[str] = []
    load(config, (), notes.append)
    assert "split" not in " ".join(notes).removeprefix(str(config))
    text = config.read_text()
    config.write_text(text.replace("split:", "splt:"))
    with pytest.raises(Exception, match="there is no key 'splt'; did you mean 'split'"):
        load(config)
    config.write_text(text + "methods: [gp]\ngp: {steps: 3}\n")
    load(config, (), notes.append)
    assert "gp, methods" in notes[-1]
