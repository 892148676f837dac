"""The small arm that a camera sees has more causes than a set holds that was searched beside a wrong one."""

from pathlib import Path

import numpy as np
from ccnn_validation.camera_arm import FILE, Arm, drawn_rows, table

from ccnn_torch.diagnosis import diagnose
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records


def test_sets_without_a_name_that_is_dropped_are_searched_anew(tmp_path: Path) -> None:
    """Backlash that weight holds has edges that mend too much: it is dropped, and what acts beside it is found."""
    arm, rng = Arm(30), np.random.default_rng([30, 1])
    rows = drawn_rows(100, rng)
    header, values = table(*rows, arm.measured(*rows, rng))
    np.savetxt(tmp_path / "rows.csv", values, "%.12g", ",", header=header, comments="")
    (tmp_path / "arm.yaml").write_text(FILE)
    effects = ["geometry", "bending", "transmission", "backlash"]
    machine = load_mechanism(str(tmp_path / "arm.yaml"))
    said = diagnose(load_records(tmp_path / "rows.csv", machine, learns=False), machine, effects=effects)
    assert "geometry" in said.verdict["effects"] and said.verdict["shrink"] > 0.8
