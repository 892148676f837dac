"""Wanted poses of arms: the turn that was measured, and orientations where positions alone were measured."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fitted import LIMITS, six_axis_arm
from torch import Tensor

from ccnn_torch.compensation.model_files.identified import model_of_machine
from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.compensation.wanted import WantedPoses
from ccnn_torch.effects import default_gravity
from ccnn_torch.effects.found_machine import FoundMachine
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.records import read_table, write_table

NONE = torch.zeros(0, 2, dtype=torch.float64)
WHOLE = six_axis_arm().pose


def model_of(arm: SerialArm, region: Tensor, path: Path, everywhere: bool = False) -> LoadedModel:
    """A model whose records had joints in a region; everywhere: it holds all over the workspace all the same."""
    joints, beside = (NONE, region) if everywhere else (region, NONE)
    about = (default_gravity(arm), joints, (), NONE, {}, {}, beside)
    return model_of_machine(path / "diagnosis.json", FoundMachine(arm, arm.nominal, [], *about))


def write_poses(path: Path, poses: Tensor, names: dict[str, str] | None = None) -> Path:
    header = {c.header: (names or {}).get(c.name, c.header) for c in WHOLE}
    write_table(path, {header[c.header]: poses[:, i].numpy() for i, c in enumerate(WHOLE[: poses.shape[1]])})
    return path


@pytest.mark.parametrize("everywhere", [False, True])
def test_joints_are_in_the_turn_in_which_they_were_measured(tmp_path: Path, everywhere: bool) -> None:
    arm = six_axis_arm()
    region = torch.tensor(LIMITS, dtype=torch.float64)
    # Half a turn and more from the home of the mechanism.
    region = region + torch.tensor([4.0, 0, 0, -4.0, 0, 5.0], dtype=torch.float64)[:, None]
    share = torch.rand(20, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joints = region[:, 0] + (region[:, 1] - region[:, 0]) * share
    file = write_poses(tmp_path / "poses.csv", arm.forward_kinematics(joints))
    found = torch.from_numpy(WantedPoses(model_of(arm, region, tmp_path, everywhere)).joints(read_table(file))[0])
    room = 0.05 * (region[:, 1] - region[:, 0]) + 1e-9
    assert bool(((found >= region[:, 0] - room) & (found <= region[:, 1] + room)).all())


def test_whole_poses_are_taken_where_positions_alone_were_measured(tmp_path: Path) -> None:
    arm = six_axis_arm().with_orientation("none")
    model = model_of(arm, torch.tensor(LIMITS, dtype=torch.float64), tmp_path)
    joints = arm.sample_joints(5, torch.Generator().manual_seed(2))
    whole = arm.with_orientation("rotation_vector")
    poses = whole.forward_kinematics(joints)
    wanted = WantedPoses(model)
    found, _ = wanted.joints(read_table(write_poses(tmp_path / "poses.csv", poses)))
    torch.testing.assert_close(whole.forward_kinematics(torch.from_numpy(found)), poses, rtol=0, atol=1e-7)
    assert [name.partition("[")[0] for name in wanted.commanded(found)] == [f"command_{c.name}" for c in WHOLE]
    # Positions alone are taken as well, but not beside an orientation that nobody reads.
    alone, _ = WantedPoses(model).joints(read_table(write_poses(tmp_path / "places.csv", poses[:, :3])))
    torch.testing.assert_close(arm.forward_kinematics(torch.from_numpy(alone)), poses[:, :3], rtol=0, atol=1e-7)
    other = write_poses(tmp_path / "rpy.csv", poses, {"rx": "roll[rad]", "ry": "pitch[rad]", "rz": "yaw[rad]"})
    with pytest.raises(InputError, match="columns roll, pitch, yaw look like an orientation"):
        WantedPoses(model).joints(read_table(other))
