"""Configs and mechanism files that went wrong."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from fuzz.conftest import ARM
from fuzz.mutate import change_text, text_changes
from fuzz.oracle import judged

pytestmark = pytest.mark.fuzz
CASES = 10

RUN = """\
name: fuzz
seed: 0
repeats: 1
out: o
records: r.csv
mechanism: five_bar
geometry: none
methods: [constant]
save_models: false
save_report: false
covariates: [time]
columns: {time: "time[s]"}
split:
  kind: random
  test: 0.3
  validation: 0.2
training:
  early_stop: true
"""
SUITE = (
    "name: s\nout: o\nbase: {case: tripod, methods: [constant], save_models: false}\ncases:\n- {name: a}\n- {name: b}\n"
)
IDENTIFY = "out: o\nmechanism: five_bar\nrecords: r.csv\nmethods: [lm]\nnoise: 1e-5\nsave_report: false\n"
PLAN = "out: p.csv\nmechanism: five_bar\nposes: 8\ncandidates: 40\n"
CONFIGS = [
    (RUN, ["run", "c.yaml", "--quiet"]),
    (SUITE, ["suite", "c.yaml", "--quiet"]),
    (IDENTIFY, ["identify", "c.yaml", "--quiet"]),
    (PLAN, ["plan", "--mechanism", "five_bar", "--poses", "8", "--out", "p.csv", "--config", "c.yaml"]),
]
URDF = """\
<robot name="r">
<link name="base"/>
<link name="one"/>
<link name="two"/>
<joint name="j1" type="revolute">
<parent link="base"/>
<child link="one"/>
<origin xyz="0 0 0.3" rpy="0 0 0"/>
<axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/>
</joint>
<joint name="j2" type="prismatic">
<parent link="one"/>
<child link="two"/>
<origin xyz="0.4 0 0" rpy="0 1.57 0"/>
<axis xyz="0 0 1"/>
<limit lower="0" upper="0.5" effort="1" velocity="1"/>
</joint>
</robot>
"""


@given(config=st.sampled_from(CONFIGS), changes=text_changes)
def test_configs(bases, fresh, config, changes) -> None:
    with fresh() as folder:
        (folder / "r.csv").write_text("\n".join(",".join(row) for row in bases["five_bar"]))
        (folder / "c.yaml").write_text(change_text(config[0], changes), encoding="utf-8", errors="replace")
        judged(config[1], folder)


@given(text=st.sampled_from([ARM, URDF]), changes=text_changes)
def test_mechanism_files(bases, fresh, text, changes) -> None:
    name = "m.yaml" if text is ARM else "m.urdf"
    with fresh() as folder:
        (folder / "r.csv").write_text("\n".join(",".join(row) for row in bases["arm"]))
        (folder / name).write_text(change_text(text, changes), encoding="utf-8", errors="replace")
        judged(["check", "--records", "r.csv", "--mechanism", name, "effects=[frame,joint_offset]"], folder)
