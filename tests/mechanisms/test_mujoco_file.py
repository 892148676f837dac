"""MJCF files that would take all memory or time: one sentence, before anything is made of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import mujoco_simulator
from ccnn_torch.mechanisms.simulators.mujoco_model import compiled, mujoco_spec
from ccnn_torch.motion.mujoco_motion import mujoco_nominal

pytest.importorskip("mujoco", reason="needs pip install 'ccnn-torch[mujoco]'")
MODEL = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="j1" axis="0 1 0" damping="0.1"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.5"/><site name="tool" pos="0.2 0 0"/></body></worldbody>
<actuator><position name="a1" joint="j1" kp="50" kv="1"/></actuator></mujoco>"""
BODY = '<body><geom size="0.01" mass="0.001"/></body>'


def _changed(old: str, new: str) -> str:
    assert old in MODEL
    return MODEL.replace(old, new)


CASES = {
    "option timestep is 0 s; write one from 1e-05 to 0.1": _changed("0.002", "0"),
    "option timestep is -1 s": _changed("0.002", "-1"),
    "option timestep is 1e-09 s": _changed("0.002", "1e-9"),
    "timestep of <option> is nan; write a number": _changed("0.002", "nan"),
    "mass of <geom> is nan": _changed('mass="0.5"', 'mass="nan"'),
    "kp of <position a1> is 1e300; write a number of at most 1e+12": _changed('kp="50"', 'kp="1e300"'),
    "has more than 500 bodies": _changed("<worldbody>", "<worldbody>" + 501 * BODY),
    "more than 500 bodies": _changed(
        "<worldbody>",
        f'<worldbody><replicate count="9999"><replicate count="9999">{BODY}</replicate></replicate>',
    ),
    "a <hfield> has 10,000,000,000 points; write at most 20,000,000": _changed(
        "<worldbody>", '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset><worldbody>'
    ),
    "document type": "<!DOCTYPE mujoco>" + MODEL,
    "is no valid XML": MODEL[:-3],
    "MuJoCo does not take it": _changed("capsule", "capsul"),
    "does not take it: Inertia matrix is too close to singular": _changed('damping="0.1"', 'armature="-1"'),
}


@pytest.mark.parametrize("sentence", CASES)
def test_what_is_beyond_all_machines_is_refused(sentence: str, tmp_path: Path) -> None:
    (tmp_path / "m.xml").write_text(CASES[sentence], encoding="utf-8")
    for make in (
        lambda path: mujoco_simulator(path, {"a1": (-1.0, 1.0)}, "tool"),
        lambda path: mujoco_nominal(str(path), {}, ["rad"]),
    ):
        with pytest.raises(InputError) as caught:
            make(tmp_path / "m.xml")
        assert sentence in str(caught.value) and "\n" not in str(caught.value), str(caught.value)
        assert str(caught.value).startswith(str(tmp_path))


def test_what_a_file_includes_is_looked_at_too(tmp_path: Path) -> None:
    (tmp_path / "m.xml").write_text(_changed("<worldbody>", '<include file="h.xml"/><worldbody>'), encoding="utf-8")
    inner = '<mujoco><asset><hfield name="h" nrow="99999" ncol="99999" size="1 1 1 1"/></asset></mujoco>'
    (tmp_path / "h.xml").write_text(inner, encoding="utf-8")
    with pytest.raises(InputError, match=r"h.xml: a <hfield> has 9,999,800,001 points"):
        mujoco_spec(tmp_path / "m.xml")


@pytest.mark.parametrize(
    ("model", "length", "sentence"),
    [
        (_changed('kp="50"', 'kp="1e11"'), 0.5, "is unstable at an option timestep of 0.002 s"),
        (_changed("0.002", "1e-5"), 1e4, "would take 1,000,100,000 steps of 1e-05 s; write an option timestep of at"),
    ],
)
def test_a_motion_that_cannot_be_simulated_is_one_sentence(
    model: str, length: float, sentence: str, tmp_path: Path
) -> None:
    (tmp_path / "m.xml").write_text(model, encoding="utf-8")
    nominal = mujoco_nominal(str(tmp_path / "m.xml"), {}, ["rad"])
    time = np.linspace(0.0, length, 50)
    assert nominal.loaded is not None
    with pytest.raises(InputError, match=sentence):
        nominal.loaded(time, np.sin(20 * time)[:, None], None)


def test_a_machine_is_read(tmp_path: Path) -> None:
    (tmp_path / "m.xml").write_text(_changed("<actuator>", "<actuator><!-- 1e300 -->"), encoding="utf-8")
    mujoco, spec = mujoco_spec(tmp_path / "m.xml")
    assert compiled(mujoco, tmp_path / "m.xml", spec).nbody == 2
