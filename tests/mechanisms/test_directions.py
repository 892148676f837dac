"""Arms that are seen by the direction in which their tool looks."""

from __future__ import annotations

from pathlib import Path

import torch

from ccnn_torch.mechanisms import SerialArm, as_measured, fit_frames, load_mechanism, sees_directions
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

DATA = Path(__file__).parents[2] / "experiments" / "data"
RIGHT = 1.5707963267948966


def mount(**keys: object) -> SerialArm:
    links = [[0.3, RIGHT, 0.5, 0.0], [1.0, 0.0, 0.0, 0.0]]
    return SerialArm("mount", "standard", links, tool_offset=[0.0, 0.0, 0.0], **keys)  # type: ignore[arg-type]


def joints(rows: int) -> torch.Tensor:
    return mount().sample_joints(rows, torch.Generator().manual_seed(0))


def test_unit_vectors_are_directions_and_other_positions_are_not() -> None:
    arm = mount()
    sight = torch.nn.functional.normalize(
        torch.randn(9, 3, generator=torch.Generator().manual_seed(1)).double(), dim=-1
    )
    assert sees_directions(as_measured(arm, arm.pose[:3], "rows", sight))
    assert not sees_directions(as_measured(arm, arm.pose[:3], "rows", 1.001 * sight))
    assert not sees_directions(as_measured(arm, arm.pose[:3], "rows"))


def test_lengths_before_the_last_axis_turn_no_direction_and_slopes_are_those_of_differences() -> None:
    arm, q = mount().with_orientation("direction"), joints(5)
    assert torch.allclose(arm.forward_kinematics(q).norm(dim=-1), torch.ones(5, dtype=torch.float64))
    values, slope, step = arm.nominal, arm.parameter_jacobian(q), 1e-6
    names = [g.name for g in arm.geometry]
    without = {"base_x", "base_y", "base_z", "a1", "d1", "alpha2", "tool_rx", "tool_ry", "tool_rz"}
    for k, name in enumerate(names):
        change = torch.zeros_like(values).index_fill(0, torch.tensor([k]), step)
        moved = (arm.forward_kinematics(q, values + change) - arm.forward_kinematics(q, values - change)) / (2 * step)
        torch.testing.assert_close(slope[..., k], moved, atol=1e-8, rtol=0)
        assert bool((moved == 0).all()) == (name in without)
    motion = (arm.forward_kinematics(q + step) - arm.forward_kinematics(q - step)) / (2 * step)
    torch.testing.assert_close(arm.jacobian(q).sum(-1), motion, atol=1e-8, rtol=0)


def test_the_base_of_directions_is_turned_and_not_shifted_whatever_one_row_says() -> None:
    arm, q = mount(unknown_frames=["base"]).with_orientation("direction"), joints(40)
    turn = torch.tensor([0.01, -0.02, 0.5], dtype=torch.float64)
    seen = arm.forward_kinematics(q) @ rotation_vector_to_matrix(turn).mT
    seen[7] = -seen[7]
    values = fit_frames(arm, q, seen)
    torch.testing.assert_close(values[:6], torch.cat([torch.zeros(3, dtype=torch.float64), turn]), atol=1e-9, rtol=0)


def test_a_mount_whose_numbers_are_of_a_point_is_seen_as_a_point() -> None:
    """CA of the alt-azimuth mount shifts its point, which the turns of a direction do not show."""
    mount = load_mechanism(str(DATA / "telescope.yaml"))
    sight = mount.forward_kinematics(torch.tensor([[0.5, 0.8], [1.0, 0.4]], dtype=torch.float64))
    assert as_measured(mount, mount.pose, "rows", sight) is mount
