"""Public repairs replayed: what the diagnosis says, and what its numbers are worth when they are typed in."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from ccnn_validation.repairs.__main__ import HEADER, line
from ccnn_validation.repairs.arms import REPAIRS, chain_of, numbers
from ccnn_validation.repairs.motion import HELD_OUT, MOTION_REPAIRS, run, typed_in as axis_with
from ccnn_validation.repairs.replay import KEPT, read, replayed, typed_in

BY_NAME = {repair.name: repair for repair in REPAIRS}
TABLES = Path(__file__).parents[2] / "docs" / "results"


def test_a_repair_by_parallel_axes_is_typed_in(tmp_path):
    """The UR10's d4 is off by 8.9 mm, which four shifts along parallel axes can mend: one of them is told."""
    found = replayed(BY_NAME["Universal Robots UR10"], tmp_path)
    assert found.content["verdict"]["effects"] == ["geometry"]
    assert found.before > 10 and found.typed < 0.03 and found.kept < KEPT
    assert found.outcome == "same motion" and len(found.shown) == 4
    told = {row[0]: read(row[-1]) for row in found.shown}
    assert told["link 3 z3"] == pytest.approx(612.0, abs=0.03) and told["link 4 z4"] == pytest.approx(572.3, abs=0.03)


def test_a_joint_that_turns_the_other_way_is_told(tmp_path):
    found = replayed(BY_NAME["Fanuc LR Mate 200iD"], tmp_path)
    assert found.outcome == "told" and line(found)[3] == "refused"


def test_what_the_fitted_tool_took_is_told(tmp_path):
    """35.5 mm along the last axis are a longer tool: nothing is wrong that could be named, and they are told."""
    found = replayed(BY_NAME["Motoman MH5"], tmp_path)
    assert found.outcome == "in the frames" and found.said.startswith("Nothing")
    assert found.content["frames"]["tool"] == pytest.approx([0.0355, 0, 0, 0, 0, 0], abs=1e-4)
    assert re.search(r"tool \(35\.\d\d, -?0\.0\d, -?0\.0\d\) mm", found.frames)


def test_what_is_shown_is_typed_in_digit_by_digit():
    shown = [
        ("link 3 z3", "19.99 mm", "± 16 µm", "204.4905 mm"),
        ("geometry error, link 5 pitch5", "0.1 rad", "± 1 mrad", "0.1309 rad = 7.500°"),
        ("zero offset, joint 2", "-2.00 mrad", "± 9 µrad", "–"),
    ]
    old = numbers(BY_NAME["KUKA LBR iiwa 14 R820"], False)
    chain, offsets = typed_in(old, shown)
    wanted = old.copy()
    wanted[2, 2], wanted[4, 4] = 204.4905, 7.5
    assert np.allclose(chain.origins[2][0], chain_of(wanted).origins[2][0], atol=0)
    assert np.allclose(chain.origins[4][1], chain_of(wanted).origins[4][1], atol=0)
    assert offsets.tolist() == pytest.approx([0, -2e-3, 0, 0, 0, 0, 0])


def test_what_is_told_of_a_motion_is_typed_into_the_model():
    """With damping and armature as people wrote them the old model moves as the repaired one."""
    knee = next(r for r in MOTION_REPAIRS if r.name == "Pi Plus, knee")
    wanted = {"q1 inertia": 0.01316 - 0.044277, "q1 viscous": 1.5 - 2.94}
    told = [{"parameters": {n: {"value": v, "unit": ""}}} for n, v in wanted.items()]
    truth, old = run(knee.repaired, HELD_OUT)[2], run(knee.old, HELD_OUT)[2]
    typed = run(axis_with(knee.old, told), HELD_OUT)[2]
    assert np.abs(old - truth).max() > 0.05 and np.abs(typed - truth).max() < 1e-3
    assert axis_with(knee.old, [{"parameters": {"q1 offset": {"value": 1.0, "unit": "rad"}}}]) is None


@pytest.mark.parametrize(("table", "repairs"), [("repairs", REPAIRS), ("repairs_motion", MOTION_REPAIRS)])
def test_the_table_has_every_repair(table, repairs):
    with open(TABLES / f"{table}.csv", encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == HEADER
    assert [row[0] for row in rows] == [f"{r.name}, {r.source}" for r in repairs]
    assert all(len(row) == len(HEADER) for row in rows)
