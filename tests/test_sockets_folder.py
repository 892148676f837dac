"""Folders of joint angles of a ball in sockets, as MUKCa records them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccnn_torch.errors import InputError
from ccnn_torch.records import read_table

Cli = Callable[..., tuple[int, str, str]]
DATA = Path(__file__).parent.parent / "experiments" / "data"


def folder(root: Path, placements: int = 3) -> Path:
    """The shipped rows as the source writes them: a folder for each placement, without headers."""
    rows = np.loadtxt(DATA / "sockets.csv", delimiter=",", skiprows=1)
    for place in range(placements):
        (root / f"place_{place}").mkdir(parents=True)
        for hole in (0, 1):
            own = rows[(rows[:, 0] == place) & (rows[:, 1] == hole)]
            np.savetxt(root / f"place_{place}" / f"hole_{hole}.csv", own[:, 2:8], delimiter=",")
            # Poses of the ball that some have beside them.
            np.savetxt(root / f"place_{place}" / f"hole_{hole}_pose.csv", own[:, :3], delimiter=",")
    return root


def test_a_folder_holds_the_rows_of_the_table(tmp_path: Path) -> None:
    found, wanted = read_table(folder(tmp_path / "arm")), read_table(DATA / "sockets.csv")
    assert found.units == wanted.units
    order = np.lexsort((wanted.raw("socket"), wanted.raw("placement")))
    np.testing.assert_allclose(found.values, wanted.values[order], atol=1e-12)
    assert any("placement 0 is place_0, 1 is place_1" in note for note in found.notes)
    assert found.name_rows([25]) == f"line 6 (row 6) of {tmp_path / 'arm' / 'place_0' / 'hole_1.csv'}"
    # One placement alone.
    assert len(read_table(tmp_path / "arm" / "place_1")) == 40


def test_from_a_folder_to_an_identified_arm(tmp_path: Path, cli: Cli) -> None:
    config = tmp_path / "arm_sockets.yaml"
    code, out, error = cli(
        "new", folder(tmp_path / "arm", 1), "--mechanism", DATA / "sockets_arm.yaml", "--out", config
    )
    assert code == 0, error
    assert f"ccnn identify {config} out=runs/arm_sockets" in out and "Not used" not in config.read_text()
    code, _, error = cli("identify", config, f"out={tmp_path / 'run'}", "--quiet")
    assert code == 0, error
    position = json.loads((tmp_path / "run" / "identified.json").read_text())["methods"]["lm"]["test"]["position"]
    assert position["after"] < 0.2 * position["before"]
    # The plate somewhere else, as many rows as a plate is left for; then joint 3 was mounted anew.
    for hole in (0, 1):
        (tmp_path / "later").mkdir(exist_ok=True)
        there = np.loadtxt(folder(tmp_path / f"all{hole}", 2) / "place_1" / f"hole_{hole}.csv", delimiter=",")
        np.savetxt(tmp_path / "later" / f"hole_{hole}.csv", there - [0, 0, 2e-3, 0, 0, 0], delimiter=",")
    code, out, error = cli(
        "diagnose", "--since", tmp_path / "run" / "identified.yaml", tmp_path / "later", "--out", tmp_path / "now"
    )
    assert code == 0 and "zero offset of q3 by +" in out, (out, error)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("hole_1.csv", "", "hole_1.csv: the file is empty"),
        ("hole_1.csv", "1,2,3\n", "hole_1.csv: has 3 joints, and"),
        ("hole_0.csv", "q1,q2\n1,2\n", "hole_0.csv: must hold joint angles"),
        ("hole_0.csv", "1,2,3,4,5,1e300\n", "larger than anything"),
    ],
)
def test_what_is_refused(tmp_path: Path, cli: Cli, name: str, text: str, said: str) -> None:
    root = folder(tmp_path / "arm", 1)
    (root / "place_0" / name).write_text(text)
    words = (f"records={root}", f"mechanism={DATA / 'sockets_arm.yaml'}", "constraint={kind: sockets, by: [placement]}")
    code, _, error = cli("identify", *words, f"out={tmp_path / 'run'}")
    assert code == 2 and said in error and error.count("\n") == 1, error


def test_a_folder_of_several_arms_is_none(tmp_path: Path) -> None:
    folder(tmp_path / "data" / "arm", 1)
    with pytest.raises(InputError, match="is a folder and no file, nor a LeRobot data set"):
        read_table(tmp_path / "data")
