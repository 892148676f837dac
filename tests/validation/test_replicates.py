"""Replicates of one machine: the same verdict, the same numbers, and each repairs the other's rows."""

import csv
import io
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from ccnn_validation import replicates
from ccnn_validation.camera import flanges
from ccnn_validation.replicates import HEADER, compared, diagnosed, halves, machines, row, summary

LINKS = np.array([[0, 0.5, 0.4], [np.pi / 2, 0, 0], [0.3, 0, 0], [0, 0, 0]])
FILE = """dof: 3
convention: standard Denavit-Hartenberg
units: {length: m, angle: rad}
a: [0, 0.5, 0.4]
alpha: [1.5707963267948966, 0, 0]
d: [0.3, 0, 0]
theta: [0, 0, 0]
base_frame: unknown
tool_offset: [0, 0, 0.05]
"""


def measured(seed: int, gain: float, rows: int = 40) -> list[str]:
    """Lines of a file of an arm whose third joint moves too far by a share of its angle."""
    rng = np.random.default_rng(seed)
    joints = rng.uniform(-1.5, 1.5, (rows, 3))
    true = joints + np.array([0, 0, gain]) * joints
    place = (flanges(true, LINKS) @ [0, 0, 0.05, 1])[:, :3] + rng.normal(0, 2e-5, (rows, 3))
    text = io.StringIO()
    np.savetxt(text, np.c_[joints, place], "%.9f", ",", header="q1[rad],q2[rad],q3[rad],x[m],y[m],z[m]", comments="")
    return text.getvalue().splitlines()


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "arm.yaml"
    path.write_text(FILE)
    return path


def test_two_days_of_one_machine_agree_and_another_machine_does_not(arm):
    one, two, other = (diagnosed(measured(seed, gain), arm) for seed, gain in ((0, 4e-3), (1, 4e-3), (2, 8e-3)))
    pair, strange = compared(one, two, True), compared(one, other, True)
    assert pair.names == (["joint_gain"], ["joint_gain"]) and pair.same
    assert pair.agree["joint_gain q3"] and not strange.agree["joint_gain q3"]
    left = pair.left
    assert left["bare"] > 8 * left["told crossed"] and left["bare"] > 8 * left["machine crossed"]
    assert 0.9 * left["told"] < left["told crossed"] < 1.2 * left["told"]
    assert strange.left["told crossed"] > 5 * strange.left["told"]
    assert strange.left["machine crossed"] > 5 * strange.left["machine"]
    assert len(row("arm", ("1", "2"), pair)) == len(HEADER)
    figures = summary([pair, strange])
    assert figures["numbers within the joint 95 % interval"]["count"] < len(pair.agree) + len(strange.agree)
    assert figures["pairs with the same names"]["share"] == 1


def test_rows_that_are_refused_are_a_verdict_of_their_own(arm):
    refused = diagnosed(measured(3, 0.0)[:10], arm)
    assert refused is None
    pair = compared(refused, None, True)
    assert pair.names == (["refused"], ["refused"]) and pair.same
    assert row("arm", ("1", "2"), pair)[1:3] == ("refused", "– / –")


def test_numbers_of_another_period_are_not_compared():
    def entry(period: float) -> dict[str, object]:
        def frequency(value: float) -> dict[str, object]:
            return {"value": value, "sd": 0.1, "searched": True}

        wave = {"value": 1.0, "sd": 0.1}
        return {
            "q1 sin": wave,
            "q2 sin": wave,
            "q1 frequency": frequency(7.0),
            "q2 frequency": frequency(period),
        }

    assert replicates._same_shape("q1 sin", entry(3.0), entry(5.0))
    assert not replicates._same_shape("q2 sin", entry(3.0), entry(5.0))
    assert replicates._same_shape("q2 sin", entry(3.0), entry(3.01))


def test_halves_share_no_row_and_keep_blocks_in_order():
    lines = ["q1[rad]", *map(str, range(103))]
    one, two = ([int(line) for line in half[1:]] for half in halves(lines, 0).values())
    assert sorted(one + two) == list(range(103)) and one == sorted(one) and abs(len(one) - len(two)) <= 11
    assert sum(b - a == 1 for a, b in pairwise(one)) > 0.8 * len(one)


def test_the_machines_of_the_repository_need_no_folder(tmp_path):
    found = machines(None, 0)
    assert len(found) == 3
    for make in found.values():
        machine = make()
        assert machine.mechanism.is_file() and all(len(lines) > 50 for lines in machine.replicates.values())
    with pytest.raises(replicates.InputError, match="CCNN_MEASURED is the folder"):
        machines(tmp_path, 0)["UR10"]()


def test_placements_are_told_apart(tmp_path):
    (tmp_path / "panda_mukca").mkdir()
    rows = ["robot[1],placement[1],q1[rad]", "1,0,0.5", "1,1,0.6", "3,0,0.7"]
    (tmp_path / "panda_mukca" / "records.csv").write_text("\n".join(rows))
    made = machines(tmp_path, 0)["Panda 1"]()
    assert made.replicates == {"placement 0": [rows[0], rows[1]], "placement 1": [rows[0], rows[2]]} and made.apart


def test_the_table_is_as_the_program_writes_it():
    path = Path(__file__).parents[2] / "docs" / "results" / "replicates.csv"
    with open(path, encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == HEADER and rows
