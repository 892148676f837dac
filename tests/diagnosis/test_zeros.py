"""An arm whose joints count from elsewhere than its model is refused with what to write, and then taken.

Four joints, two of which the frames take: every further one makes the search longer.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ccnn_torch import diagnose, load_mechanism, load_records
from ccnn_torch.errors import InputError

NOISE = 2e-5
ZEROS = np.radians([0, 0, 40, 0])
ARM = f"""\
dof: 4
convention: standard Denavit-Hartenberg
units: {{length: m, angle: rad}}
a: [0.1, -0.6, -0.55, 0]
alpha: [{np.pi / 2}, 0, {np.pi / 2}, 0]
d: [0.13, 0, 0, 0.11]
theta: [0, 0, 0, 0]
base_frame: unknown
tool_frame: unknown
"""


def _rows(folder: Path, names: list[str], there: NDArray[np.float64], pose: NDArray[np.float64]) -> Path:
    path = folder / "rows.csv"
    header = ",".join([*(f"q{i}[rad]" for i in range(1, 5)), *names])
    np.savetxt(path, np.c_[there, pose], "%.9f", ",", header=header, comments="")
    return path


@pytest.mark.parametrize("orientation", [True, False])
def test_zeros_are_told_as_they_have_to_be_written(tmp_path: Path, orientation: bool) -> None:
    model = tmp_path / "arm.yaml"
    model.write_text(ARM)
    arm, rng = load_mechanism(str(model)), np.random.default_rng(3)
    shown = rng.uniform(-2, 2, (24, 4))
    pose = arm.forward_kinematics(torch.from_numpy(shown * [1, -1, 1, 1] + ZEROS)).numpy()
    channels = 6 if orientation else 3
    names = ["x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"][:channels]
    path = _rows(tmp_path, names, shown, (pose + rng.normal(0, NOISE, pose.shape))[:, :channels])
    with pytest.raises(InputError, match="joint q2 seems to count in the other direction, joint q3") as refusal:
        diagnose(load_records(path, arm), arm)
    told = re.findall(r'(q\d): "([^"]+)"', str(refusal.value))
    assert [name for name, _ in told] == ["q2", "q3"] and told[1][1].startswith("q3 + ")
    arm = load_mechanism(str(model))
    said = diagnose(load_records(path, arm, joint_map=dict(told)), arm, noise=NOISE, effects=["joint_offset"])
    assert said.gap["before"] < 5e-4


def test_a_model_of_another_arm_is_refused_without_zeros(tmp_path: Path) -> None:
    model = tmp_path / "arm.yaml"
    model.write_text(ARM)
    arm, rng = load_mechanism(str(model)), np.random.default_rng(4)
    names = ["x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"]
    path = _rows(tmp_path, names, rng.uniform(-2, 2, (24, 4)), rng.uniform(-1, 1, (24, 6)))
    with pytest.raises(InputError, match="check the units"):
        diagnose(load_records(path, arm), arm)
