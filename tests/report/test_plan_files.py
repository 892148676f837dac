"""The files of `ccnn plan`, figures among them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records, read_table

Cli = Callable[..., tuple[int, str, str]]
FAST = ("candidates=200", "noise=1e-4")


def test_a_plan_is_a_file_for_the_machine_and_a_page_for_the_person(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "new" / "poses.csv"
    code, told, err = cli("plan", "--mechanism", "five_bar", "--poses", 10, "--out", out, *FAST)
    assert code == 0 and err == ""
    assert "10 poses for 12 parameters: O1 is" in told
    mechanism = load_mechanism("five_bar")
    table = read_table(out)
    assert list(table.names) == ["q1", "q2", "x", "y"] and set(table.units.values()) == {"rad", "m"}
    records = load_records(out, mechanism)
    assert torch.equal(mechanism.solve_inverse(records.pose), records.joints)  # 17 digits: the floats themselves
    page = out.with_suffix(".md").read_text()
    assert "poses.png" in page and "## What each further pose gives" in page and "| gamma2 | " in page
    assert {f.suffix for f in out.parent.iterdir()} == {".csv", ".html", ".md", ".png", ".svg"}
    assert "<svg" in (shown := out.with_suffix(".html").read_text()) and "What each further pose gives" in shown


def test_each_leg_has_its_rows_and_the_same_seed_gives_the_same_bytes(cli: Cli, tmp_path: Path) -> None:
    words = ("plan", "--mechanism", "five_bar", "--poses", 7, "--seed", 3, "--quiet", "per_leg=true", *FAST)
    for name in ("a.csv", "b.csv"):
        assert cli(*words, "--out", tmp_path / name) == (0, "", "")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    table = read_table(tmp_path / "a.csv")
    assert table.names[0] == "leg"
    assert np.asarray(table.raw("leg"), dtype=float).tolist() == [1.0] * 7 + [2.0] * 7
