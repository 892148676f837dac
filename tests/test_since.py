"""What changed since a model was made: rows of a planar arm of formulas of its own, and the shipped tripod's model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ccnn_validation import changes
from numpy.typing import NDArray

import ccnn_torch
from ccnn_torch import load_model
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import IDENTIFY
from ccnn_torch.records import write_table
from ccnn_torch.verification.job import nominal_mechanism

Array = NDArray[np.float64]
TRIPOD = Path(__file__).parent.parent / "checkpoints" / "tripod" / "model.safetensors"
ARM = (
    "dof: 3\nconvention: standard Denavit-Hartenberg\nunits: {length: m, angle: rad}\n"
    "a: [0.3, 0.25, 0.2]\nalpha: [0, 0, 0]\nd: [0, 0, 0]\ntheta: [0, 0, 0]\n"
    "base_frame: unknown\ntool_frame: [0, 0, 0, 0, 0, 0]\n"
)


def reached(joints: Array, lengths: tuple[float, float, float] = (0.3006, 0.2496, 0.2003)) -> tuple[Array, Array]:
    """Positions and turns about z; the arm as built."""
    turned = joints.cumsum(1)
    x, y = (sum(a * one(turned[:, k]) for k, a in enumerate(lengths)) for one in (np.cos, np.sin))
    return np.stack([x, y, 0 * x], 1), turned[:, -1]


def write(path: Path, joints: Array, seed: int, actual: Array | None = None, shift: Array | None = None) -> None:
    """Rows with 20 um and 20 urad of noise; actual: where the joints really were; shift: of the tracker [m]."""
    draw = np.random.default_rng(seed)
    place, turn = reached(joints if actual is None else actual)
    place = place + draw.normal(0, 2e-5, place.shape) + (0.0 if shift is None else shift)
    turn = turn + draw.normal(0, 2e-5, turn.shape)
    tilt = draw.normal(0, 2e-5, (len(turn), 2))
    columns = {f"q{k + 1}[rad]": joints[:, k] for k in range(3)} | {f"{a}[m]": place[:, k] for k, a in enumerate("xyz")}
    write_table(path, columns | {"rx[rad]": tilt[:, 0], "ry[rad]": tilt[:, 1], "rz[rad]": turn})


def drawn(seed: int, count: int) -> Array:
    return np.random.default_rng(seed).uniform([-0.8, -0.8, -0.8], [0.8, 0.8, 0.8], (count, 3))


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("since")
    (folder / "arm.yaml").write_text(ARM)
    write(folder / "then.csv", drawn(0, 80), 1)
    keys: dict[str, Any] = {"records": str(folder / "then.csv"), "mechanism": str(folder / "arm.yaml")}
    IDENTIFY.start(IdentifyConfig.from_keys(**keys, out=str(folder / "run"), save_report=False), quiet=True)
    return folder / "run" / "identified.yaml"


def test_a_lost_zero_is_told_with_its_number_and_is_gone_when_it_is_set(identified: Path, tmp_path: Path) -> None:
    for seed, joint, size in ((10, 1, 5e-4), (11, 2, -8e-4), (12, 1, -3e-4)):
        joints = drawn(seed, 10)
        actual = joints + size * np.eye(3)[joint]
        write(tmp_path / "new.csv", joints, seed, actual)
        said = ccnn_torch.since(identified, tmp_path / "new.csv")
        assert [told.name for told in said.changed] == [f"joint_offset q{joint + 1}"], said.text
        (number,) = said.changed[0].numbers
        assert number.value == pytest.approx(size, abs=4 * number.sd) and number.sd < 5e-5
        assert said.position.after is not None and said.position.after < 0.3 * said.position.before
        assert said.probability > 0.8 and not said.rest
        # A gear ratio with a zero of its own says the same and more; these rows show that it is right.
        assert not said.changed[0].instead and "± at 95 %" in said.text


def test_nothing_is_told_of_the_same_machine_and_what_would_have_been_seen(identified: Path, tmp_path: Path) -> None:
    for seed in range(20, 24):
        write(tmp_path / "new.csv", drawn(seed, 10), seed)
        said = ccnn_torch.since(identified, tmp_path / "new.csv")
        assert not said.changed and not said.rest and said.text.startswith("Nothing changed that these rows show")
        seen = {change.name: change.seen_from for change in said.changes}
        assert 2e-5 < seen["joint_offset q2"] < 4e-4


def test_a_device_set_up_anew_hides_its_own_motion_alone(identified: Path, tmp_path: Path) -> None:
    joints = drawn(30, 10)
    write(tmp_path / "new.csv", joints, 30, joints + np.array([0, 6e-4, 0]), np.array([0.4, -0.1, 0.2]))
    said = ccnn_torch.since(identified, tmp_path / "new.csv")
    assert [told.name for told in said.changed] == ["joint_offset q2"]
    assert "stands elsewhere" in said.notes[0] and "458 mm" in said.notes[0]
    assert all(change.name != "frame" for change in said.changes)


def test_a_change_that_no_part_makes_is_a_rest(identified: Path, tmp_path: Path) -> None:
    joints = drawn(40, 24)
    actual = joints + 1.5e-3 * np.sin(23 * joints[:, :1] * [1, 0, 0]) + 1.5e-3 * np.sin(31 * joints[:, 1:2] * [0, 1, 0])
    write(tmp_path / "new.csv", joints, 40, actual)
    said = ccnn_torch.since(identified, tmp_path / "new.csv")
    assert said.rest and said.probability <= 0.6


def test_a_network_is_part_of_the_model(tmp_path: Path) -> None:
    model = load_model(TRIPOD)
    machine = nominal_mechanism(model, None, False)
    draw = np.random.default_rng(3)
    ends = [model.facts["domain"]["inputs"][f"q{k}"] for k in (1, 2, 3)]
    middle, half = (np.array([(e["high"] + sign * e["low"]) / 2 for e in ends]) for sign in (1, -1))
    joints = middle + 0.5 * half * draw.uniform(-1, 1, (12, 3))
    actual = torch.from_numpy(np.asarray(model(joints)["ideal"])) + torch.tensor([0.0, 4e-4, 0.0], dtype=torch.float64)
    pose = machine.forward_kinematics(actual).numpy()
    columns = {f"q{k + 1}[m]": joints[:, k] for k in range(3)}
    columns |= {f"{c.name}[{c.unit}]": pose[:, k] + draw.normal(0, 1e-5, 12) for k, c in enumerate(machine.pose)}
    write_table(tmp_path / "new.csv", columns)
    said = ccnn_torch.since(TRIPOD, tmp_path / "new.csv")
    assert [told.name for told in said.changed] == ["joint_offset q2"], said.text
    assert said.changed[0].numbers[0].value == pytest.approx(4e-4, rel=0.1)


def test_a_change_of_several_numbers_is_told_with_those_that_are_clear_of_0(identified: Path, tmp_path: Path) -> None:
    joints = drawn(30, 12)
    write(tmp_path / "new.csv", joints, 30, shift=np.array([8e-4, 0.0, 0.0]))
    said = ccnn_torch.since(identified, tmp_path / "new.csv")
    (told,) = said.changed
    clear = [number for number in told.numbers if abs(number.value) > 1.96 * number.sd]
    assert len(told.numbers) > len(clear) > 0, said.text
    assert f"({clear[0].name} {1e6 * clear[0].value:+.3g} ± " in said.text and "more are not clear of 0)" in said.text


def test_the_command_and_its_files(
    cli: Callable[..., tuple[int, str, str]], identified: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    joints = drawn(50, 10)
    write(tmp_path / "new.csv", joints, 50, joints + np.array([0, 0, 7e-4]))
    code, out, err = cli("diagnose", "--since", identified, "new.csv", "--out", "now")
    assert code == 0 and "zero offset of q3 by +" in " ".join(out.split()), err
    found = json.loads((tmp_path / "now" / "since.json").read_text())
    assert found["changed"][0]["name"] == "joint_offset q3"
    page = (tmp_path / "now" / "since.html").read_text()
    assert "joint_offset" not in page and page.index('id="machine"') < page.index("What changed?")
    monkeypatch.setattr("webbrowser.open", lambda page: True)
    assert cli("report", "now")[0] == 0
    assert (tmp_path / "now" / "next_measurements.csv").read_text().startswith("q1[deg],q2[deg],q3[deg],gain[1]")
    code, out, _ = cli("verify", identified, "new.csv", "--out", "v")
    assert code == 1 and f"ccnn diagnose --since {identified} " in out
    code, _, err = cli("diagnose", "--since", identified, "--out", "now")
    assert code == 2 and "needs new rows" in err


def test_too_few_rows_and_a_model_without_a_promise_are_refused(identified: Path, tmp_path: Path) -> None:
    write(tmp_path / "new.csv", drawn(60, 3), 60)
    with pytest.raises(InputError, match=r"new.csv: has 3 configurations; measure 4 or more"):
        ccnn_torch.since(identified, tmp_path / "new.csv")
    shutil.copy(identified, tmp_path)
    with pytest.raises(InputError, match="promises no error of the position"):
        ccnn_torch.since(tmp_path / identified.name, tmp_path / "new.csv")


def test_the_judge_puts_changes_into_rows_and_compares_what_is_told(
    identified: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "new.csv", drawn(70, 12), 70)
    words = ["changes", str(identified), str(tmp_path / "new.csv"), "--draws", "1", "--out", str(tmp_path / "out.csv")]
    monkeypatch.setattr("sys.argv", words)
    changes.main()
    lines = (tmp_path / "out.csv").read_text().splitlines()
    kinds = [line.split(",")[0].split()[0] for line in lines[1:]]
    assert kinds == [
        "nothing",
        "joint_offset",
        "joint_gain",
        "frame",
        "tool",
    ]
    assert lines[1].startswith("nothing,nothing,yes") and "claims at 0.9" in capsys.readouterr().out
