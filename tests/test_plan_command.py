"""`ccnn plan`: the files it writes, and one sentence for everything that is wrong."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccnn_torch.config.keys import list_keys
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.planning.config import PlanConfig
from ccnn_torch.planning.job import make_plan
from ccnn_torch.records import read_table

Cli = Callable[..., tuple[int, str, str]]
FAST = ("candidates=200", "noise=1e-4")


def test_the_config_says_what_is_free_and_where_poses_may_be(cli: Cli, tmp_path: Path) -> None:
    config = tmp_path / "plan.yaml"
    config.write_text(
        "parameters: {free: [leg1.*], fixed: [k1], prior: {A1x: 1e-4}}\n"
        "limits: {x: [-0.2, 0.3]}\nnoise: {x: 1e-5, y: 2e-5}\ncandidates: 300\nleast_gain: 0.5\n"
    )
    out = tmp_path / "p.csv"
    code, told, _ = cli("plan", "--mechanism", "five_bar", "--poses", 8, "--out", out, "--config", config)
    assert code == 0 and "8 poses for 5 parameters" in told and "After" in told
    x = np.asarray(read_table(out).raw("x"), dtype=float)
    assert x.min() >= -0.2 and x.max() <= 0.3
    assert "so that O1 is largest" in out.with_suffix(".md").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--poses", "5", "fixed=[k1]"), "there is no key 'fixed'; did you mean 'parameters.fixed'?"),
        (("--poses", "5"), "5 poses of 2 equations cannot determine 12 parameters; plan at least 6"),
        (("--poses", "0"), "--poses: plan at least 1 pose, not 0"),
        (("--poses", "8", "index=O3"), "there is no key 'index'"),
        (("--poses", "8", "noise={x: 1e-4}"), "noise: gives no size of y"),
        (("--poses", "8", "joint_noise={p1: 1e-4}"), "joint_noise.p1: there is no such name"),
        (("--poses", "8", "limits={z: [0, 1]}"), "has no joint or pose coordinate 'z'"),
        (("--poses", "8", "parameters.free=[B1x]"), "B1x"),
        (("--poses", "8", "noise='0.1 deg'"), "noise is in 'deg', an angle, but must be a length; write e.g. 0.4 mm"),
        (("--poses", "8", "noise=0"), "noise: a standard deviation is above 0"),
        (("--poses", "8", "joint_noise=-1"), "joint_noise: a standard deviation is not negative"),
        (("--poses", "8", "limits={x: [0, 1 rad]}"), "limits.x is in 'rad', an angle, but must be a length"),
        (("--poses", "8", "parameters.prior={l1: 0.5 deg}"), "parameters.prior.l1 is in 'deg', an angle, but must be"),
        (("--poses", "8", "parameters.prior={'*': 0.5 mm}"), "is in 'mm', a length, but must be a number without unit"),
        (("--poses", "eight"), "unable to parse string as an integer"),
    ],
)
def test_bad_input_is_one_sentence(cli: Cli, tmp_path: Path, words: tuple[str, ...], sentence: str) -> None:
    code, _, err = cli("plan", "--mechanism", "five_bar", "--out", tmp_path / "p.csv", *words, *FAST[:1])
    assert code == 2 and sentence in err
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_no_csv_or_cannot_be_written_is_said(cli: Cli, tmp_path: Path) -> None:
    code, _, err = cli("plan", "--mechanism", "five_bar", "--poses", 8, "--out", tmp_path / "p.txt", *FAST)
    assert code == 2 and "must end in .csv" in err
    (tmp_path / "file").write_text("")
    code, _, err = cli("plan", "--mechanism", "five_bar", "--poses", 8, "--out", tmp_path / "file" / "p.csv", *FAST)
    assert code == 2 and "cannot be made" in err


def test_every_key_is_described_and_an_empty_config_is_the_defaults(tmp_path: Path) -> None:
    keys = [*list_keys(PlanConfig)]
    assert all(description for _, _, description in keys)
    empty = tmp_path / "empty.yaml"
    empty.write_text("")
    assert PlanConfig.from_file(empty) == PlanConfig.from_file(None)
    assert {key.partition(".")[0] for key, _, _ in keys} == set(PlanConfig.model_fields)


def test_a_mechanism_that_is_at_hand_needs_no_name() -> None:
    told: list[float] = []
    config = PlanConfig.from_file(None, ["candidates=200"])
    mechanism, plans = make_plan(load_mechanism("tripod"), 6, config, told.append)
    assert mechanism.name == "tripod" and len(plans) == 1 and told == sorted(told)
    with pytest.raises(InputError, match="unknown mechanism 'tripot'"):
        make_plan("tripot", 6, config)


def test_the_page_on_planning_lists_every_key_as_it_is() -> None:
    page = (Path(__file__).parent.parent / "docs" / "how_to" / "planning.md").read_text()
    for key, default, description in list_keys(PlanConfig):
        assert f"| `{key}` | `{default}` | {description} |" in page


def test_sizes_may_have_units_as_in_identify(cli: Cli, tmp_path: Path) -> None:
    words = ("plan", "--mechanism", "five_bar", "--poses", 8, "--quiet", "candidates=300")
    plain = ("noise=1e-4", "joint_noise=1e-5", "limits={x: [-0.2, 0.3]}", "parameters.prior={l1: 5e-4}")
    sized = (
        "noise='0.1 mm'",
        "joint_noise='0.01 mrad'",
        "limits={x: [-200 mm, 30 cm]}",
        "parameters.prior={l1: 0.5 mm}",
    )
    for name, keys in (("a.csv", plain), ("b.csv", sized)):
        assert cli(*words, "--out", tmp_path / name, *keys) == (0, "", "")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_an_arm_is_planned_for_what_poses_can_tell(cli: Cli, tmp_path: Path) -> None:
    """Base against first joint, parallel axes, tool against last joint: all are left out in one go, and said."""
    arm = Path(__file__).parents[1] / "experiments" / "data" / "ur10.yaml"
    out = tmp_path / "p.csv"
    code, told, _ = cli("plan", "--mechanism", arm, "--poses", 12, "--out", out, "candidates=300")
    assert code == 0
    for text in (told.replace("\n", " "), out.with_suffix(".md").read_text()):
        assert "No pose distinguishes: base_z and d1 only as 1.00 base_z + 1.00 d1;" in text
        assert "theta6 and tool_rz only as" in text


def test_a_machine_that_a_language_cannot_move_is_refused(cli: Cli, tmp_path: Path) -> None:
    code, _, err = cli("plan", "--mechanism", "delta", "--poses", 30, "--out", tmp_path / "d.csv", "program=urscript")
    assert code == 2 and "urscript takes six joints that turn, and the machine has 3" in err


@pytest.mark.parametrize(
    ("language", "suffix", "move"),
    [
        ("krl", ".src", r"PTP \{(.*)\}"),
        ("rapid", ".mod", r"MoveAbsJ \[\[(.*?)\]"),
        ("urscript", ".script", r"movej\(\[(.*)\],"),
        ("gcode", ".ngc", r"G1 (.*) F600"),
    ],
)
def test_planned_poses_are_a_robot_program_too(cli: Cli, tmp_path: Path, language: str, suffix: str, move: str) -> None:
    """Joints as the controller counts them, in degrees: a Fanuc-like third joint counts from the horizontal."""
    arm = Path(__file__).parents[1] / "experiments" / "data" / "ur10.yaml"
    out = tmp_path / "7 plan; x.csv"
    words = ["candidates=24", f"program={language}", 'joint_map={q3: "q3 - q2"}']
    code, _, err = cli("plan", "--mechanism", arm, "--poses", 12, "--out", out, *words)
    assert code == 0, err
    text = out.with_suffix(suffix).read_text()
    # A stranger's file name is no code.
    assert ";" not in text.splitlines()[0] and "p_7_plan__x" in text
    numbers = [[float(n) for n in re.findall(r"-?\d+\.\d{4}", m)] for m in re.findall(move, text)]
    with out.open(newline="") as file:
        rows = [{name.partition("[")[0]: float(v) for name, v in row.items()} for row in csv.DictReader(file)]
    assert len(numbers) == len(rows) == 12
    for shown, row in zip(numbers, rows, strict=True):
        q = [math.degrees(row[f"q{k}"]) for k in range(1, 7)]
        assert shown[:6] == pytest.approx([q[0], q[1], q[2] + q[1], *q[3:]], abs=1e-4)
