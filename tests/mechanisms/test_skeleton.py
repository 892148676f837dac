"""Lines that a machine is drawn with: they have the lengths of its links and end where the pose is."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.mechanisms.drawn import drawn

ROOT = Path(__file__).parents[2]


def _drawn(name: str) -> tuple[Mechanism, Tensor, Tensor, dict[str, Tensor]]:
    mechanism = load_mechanism(name)
    pose = mechanism.sample_workspace(1, torch.Generator().manual_seed(3))[0]
    joints = mechanism.solve_inverse(pose)
    return mechanism, pose, joints, mechanism.skeleton(pose, joints)


def _lengths(line: Tensor) -> list[float]:
    return (line[1:] - line[:-1]).norm(dim=-1).tolist()


@pytest.mark.parametrize(
    ("name", "legs", "lengths"),
    [
        ("five_bar", 2, {0: 0.75, 1: 1.1}),
        ("delta", 3, {0: 0.25, 1: 0.55, 2: 0.05}),
        ("delta_linear", 3, {1: 0.6, 2: 0.05}),
        ("tripod", 3, {0: 1.0, 1: 0.3}),
        ("machine_tool", 3, {1: 0.6}),
    ],
)
def test_legs_have_their_lengths_and_meet_at_the_pose(name: str, legs: int, lengths: dict[int, float]) -> None:
    mechanism, pose, _, lines = _drawn(name)
    assert list(lines) == [f"leg {i + 1}" for i in range(legs)]
    for line in lines.values():
        told = _lengths(line)
        assert [told[i] for i in lengths] == pytest.approx(list(lengths.values()), abs=1e-12)
        assert torch.allclose(line[-1], mechanism.frame(pose)[0], atol=1e-12)


def test_legs_of_a_stewart_platform_are_as_long_as_its_joints() -> None:
    _, _, joints, lines = _drawn("stewart")
    assert [_lengths(lines[f"leg {i + 1}"])[0] for i in range(6)] == pytest.approx(joints.tolist(), abs=1e-12)
    assert torch.equal(lines["base"][0], lines["leg 1"][0]) and len(lines["platform"]) == 7


def test_an_arm_ends_at_its_tool_in_its_own_base_wherever_that_stands() -> None:
    arm = load_mechanism(str(ROOT / "experiments/data/ur10.yaml"))
    values = arm.nominal.clone()
    values[:6] = torch.tensor([3.0, -2.0, 0.5, 0.1, 0.7, -0.4])
    values[-6:-3] = torch.tensor([0.05, 0.0, 0.1])
    joints = arm.sample_joints(1, torch.Generator().manual_seed(1))[0]
    lines = arm.skeleton(arm.home_pose, joints, values)
    assert list(lines) == [*(f"link {i + 1}" for i in range(6)), "tool"]
    assert lines["link 1"][0].abs().max() == 0
    position = arm.forward_frame(joints, values)[0]
    inside, turned = arm.in_own_base(position, torch.eye(3, dtype=torch.float64), values)
    assert torch.allclose(lines["tool"][1], inside, atol=1e-12)
    # Vectors only turn.
    further = arm.in_own_base(position + torch.tensor([0.0, 0.2, 0.0]), turned, values)[0]
    assert torch.allclose(further - inside, 0.2 * turned[1], atol=1e-12)


def test_errors_are_drawn_beside_the_lines_wherever_an_arm_was_measured() -> None:
    arm = load_mechanism(str(ROOT / "experiments/data/ur10.yaml"))
    values = arm.nominal.clone()
    values[:6] = torch.tensor([3.0, -2.0, 0.5, 0.1, 0.7, -0.4])
    joints = arm.sample_joints(9, torch.Generator().manual_seed(1))
    pose, place = arm.forward_kinematics(joints, values), arm.forward_frame(joints, values)[0]
    error = torch.tensor([0.0, 1e-3, 0.0], dtype=torch.float64).expand_as(place)
    found = drawn(arm, joints, pose, place, error, 0 * error, values)
    reached = found["drawn.line.tool"][1]
    assert (found["drawn.place"] - reached).norm(dim=-1).min() < 1e-12
    assert torch.allclose(found["drawn.before"][0], arm.in_own_base(place[0], error[:1], values)[1][0])
    sizes = drawn(arm, joints, pose, place, error.norm(dim=-1), 0 * error[:, 0], values)
    assert torch.equal(sizes["drawn.place"], found["drawn.place"]) and sizes["drawn.before"].ndim == 1
    lost = drawn(arm, joints, pose, torch.full_like(place, torch.nan), error, error, values)
    assert not [name for name in lost if name.startswith("drawn.line")]


def test_a_machine_that_does_not_draw_itself_has_no_lines() -> None:
    assert _drawn(f"{ROOT}/experiments/my_mechanism.py:Planar3RRR")[-1] == {}
