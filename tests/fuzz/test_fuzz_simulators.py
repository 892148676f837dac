"""MuJoCo models and logs of motion with values that no machine has: a sentence or numbers, in time."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from motion.servo import command

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, mujoco_simulator
from ccnn_torch.motion import load_logs
from ccnn_torch.motion.mujoco_motion import mujoco_nominal
from ccnn_torch.records import write_table
from fuzz.mutate import change_table, change_text, table_changes, text_changes
from fuzz.oracle import limited

pytestmark = pytest.mark.fuzz
CASES = 12

MODEL = """<mujoco><option timestep="0.002" gravity="0 0 -9.81" density="0"/><worldbody><body pos="0 0 0.1">
<joint name="j1" axis="0 1 0" damping="0.1" armature="0.01" range="-2 2" stiffness="1" frictionloss="0.01"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.5"/><site name="tool" pos="0.2 0 0"/></body></worldbody>
<actuator><position name="a1" joint="j1" kp="50" kv="1" forcerange="-5 5" ctrlrange="-2 2"/></actuator></mujoco>"""
VALUES = re.findall(r'"[-0-9. ]+"', MODEL)
HOSTILE = [
    *("0", "-1", "nan", "inf", "-inf", "1e300", "-1e300", "1e-320", "1e9", "1e-9", "", " ", "x", "1,5", "0x10"),
    *("9" * 400, "1 2 3 4 5 6 7 8 9", "1 nan 0", "é", "true", "--1", "1e400"),
]


@given(
    at=st.lists(st.tuples(st.integers(0, len(VALUES) - 1), st.sampled_from(HOSTILE)), min_size=1, max_size=3),
    changes=text_changes,
    broken=st.booleans(),
)
def test_mujoco_models(fresh: Any, at: list[tuple[int, str]], changes: Any, broken: bool) -> None:
    pytest.importorskip("mujoco", reason="needs pip install 'ccnn-torch[mujoco]'")
    parts = re.split(r'("[-0-9. ]+")', MODEL)
    for place, value in at:
        parts[2 * place + 1] = f'"{value}"'
    text = change_text("".join(parts), changes) if broken else "".join(parts)
    with fresh() as folder, limited():
        (folder / "m.xml").write_text(text, encoding="utf-8", errors="replace")
        for make in (_poses, _nominal):
            try:
                make(str(folder / "m.xml"))
            except InputError as reason:
                assert "\n" not in str(reason) and len(str(reason)) < 2100, str(reason)


def _poses(path: str) -> None:
    """A pose that is no number is said by NaN, never by infinity."""
    machine = BlackBox(mujoco_simulator(path, {"a1": (-1.0, 1.0)}, "tool"))
    pose = machine.forward_kinematics(torch.linspace(-1, 1, 3, dtype=torch.float64)[:, None])
    assert not bool(torch.isinf(pose).any())


def _nominal(path: str) -> None:
    """And the motion that it makes of a short command."""
    time = np.arange(0, 0.2, 0.01)
    loaded = mujoco_nominal(path, {}, ["rad"]).loaded
    assert loaded is not None
    found = loaded(time, command(0, time)[:, None], None)
    assert all(np.isfinite(part).all() for part in found)


def _log() -> list[list[str]]:
    time = np.arange(0, 1.5, 0.01)
    asked = command(0, time)
    # A servo of first order, which is near enough to be diagnosed.
    reached, left = [], 0.0
    for value in asked:
        left += 0.2 * (value - left)
        reached.append(left)
    rows = zip(time, asked, reached, strict=True)
    return [["time[s]", "command1[rad]", "q1[rad]"], *([f"{v:.9g}" for v in row] for row in rows)]


@given(
    changes=table_changes,
    separator=st.sampled_from([",", ";", "\t"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    columns=st.sampled_from([None, {"q": "x"}, {"q1": "position1[rad]"}]),
)
def test_logs(fresh: Any, changes: Any, separator: str, encoding: str, columns: dict[str, str] | None) -> None:
    with fresh() as folder, limited():
        text = "\n".join(separator.join(row) for row in change_table(_log(), changes))
        (folder / "log.csv").write_bytes(text.encode(encoding, errors="replace"))
        try:
            logs = load_logs([folder / "log.csv"], columns)
        except InputError as reason:
            assert "\n" not in str(reason) and len(str(reason)) < 2100, str(reason)
        else:
            assert all(np.isfinite(part).all() for log in logs for part in (log.time, log.command, log.position))


def test_the_log_itself_is_read(fresh: Any) -> None:
    with fresh() as folder:
        names, *rows = _log()
        write_table(folder / "log.csv", dict(zip(names, np.array(rows, float).T, strict=True)))
        (log,) = load_logs([folder / "log.csv"])
        assert len(log.time) == len(rows)
