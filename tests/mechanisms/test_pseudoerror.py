"""Joint deviations: injected ones come back, what joints cannot explain is told apart, bad rows are named."""

import pytest
import torch
from catalogue import make

from ccnn_torch.mechanisms import Tripod
from ccnn_torch.pseudoerror import joint_deviations


@pytest.mark.parametrize("name", ["tripod", "machine_tool", "five_bar", "ur10"])
def test_injected_deviations_come_back(name, tmp_path):
    """The machine goes to the pose of q + δ when told q: δ(q) = g(X) - q is δ again."""
    machine, generator = make(name, tmp_path), torch.Generator().manual_seed(0)
    commanded = machine.sample_joints(60, generator)
    commanded = commanded[machine.condition_number(commanded) < 150]
    injected = 1e-4 * torch.randn(commanded.shape, generator=generator, dtype=torch.float64)
    measured = machine.forward_kinematics(commanded + injected)
    found = joint_deviations(machine, commanded, measured, max_condition=150.0)
    assert found.usable.all() and len(commanded) > 20
    torch.testing.assert_close(found.deviation, injected, rtol=0, atol=1e-10)
    assert float(found.remainder_position.max()) < 1e-10
    assert found.notes() == []


def test_every_repeat_has_its_own_parameters(tmp_path):
    arm, generator = make("ur10", tmp_path), torch.Generator().manual_seed(1)
    commanded = arm.sample_joints(30, generator)
    measured = arm.forward_kinematics(commanded)
    sets = arm.nominal.repeat(3, 1, 1)
    sets[1, 0, 9] += 1e-3  # theta1: the nominal model already turns by a milliradian
    sets[2, 0, 0] += 1e-3
    found = joint_deviations(arm, commanded, measured, sets, max_condition=100.0)
    assert found.deviation.shape == (3, 30, 6) and found.usable.shape == (3, 30)
    for i in range(3):
        alone = joint_deviations(arm, commanded, measured, sets[i, 0], max_condition=100.0)
        fine = alone.usable
        torch.testing.assert_close(found.deviation[i][fine], alone.deviation[fine], rtol=0, atol=1e-10)
    fine = found.usable[1]
    expected = torch.zeros(6, dtype=torch.float64)
    expected[0] = -1e-3
    torch.testing.assert_close(found.deviation[1][fine], expected.expand(int(fine.sum()), 6), rtol=0, atol=1e-9)


def test_chunks_do_not_change_anything(tmp_path, monkeypatch):
    arm, generator = make("ur10", tmp_path), torch.Generator().manual_seed(1)
    commanded = arm.sample_joints(25, generator)
    measured = arm.forward_kinematics(commanded + 1e-3)
    whole = joint_deviations(arm, commanded, measured)
    monkeypatch.setattr("ccnn_torch.pseudoerror._CHUNK", 4)
    parts = joint_deviations(arm, commanded, measured)
    torch.testing.assert_close(parts.deviation, whole.deviation, rtol=0, atol=1e-12)
    assert torch.equal(parts.usable, whole.usable)
    sets = arm.nominal.repeat(2, 25, 1)
    sets[1, 20:, 0] += 1e-3
    by_row = joint_deviations(arm, commanded, measured, sets)
    torch.testing.assert_close(by_row.deviation[0], whole.deviation, rtol=0, atol=1e-12)
    changed = (by_row.deviation[1] - whole.deviation).abs().amax(-1) > 1e-9
    assert changed.tolist() == [False] * 20 + [True] * 5


def test_repeats_may_lead_the_poses(tmp_path):
    """Simulated repeats: one command, a measured pose per repeat."""
    tripod, generator = Tripod(), torch.Generator().manual_seed(0)
    commanded = tripod.sample_joints(7, generator)
    injected = 1e-4 * torch.randn(3, 7, 3, generator=generator, dtype=torch.float64)
    found = joint_deviations(tripod, commanded, tripod.forward_kinematics(commanded + injected))
    torch.testing.assert_close(found.deviation, injected, rtol=0, atol=1e-12)
    assert found.usable.shape == (3, 7)


def test_singular_rows_are_flagged_and_named(tmp_path):
    """A straight wrist (q5 = 0) cannot turn about one axis: a millimetre-free measurement error blows δ up there."""
    arm = make("ur10", tmp_path)
    commanded = arm.home_joints.repeat(3, 1)
    commanded[1, 4] = 1e-4
    measured = arm.forward_kinematics(commanded)
    measured[:, 3:] += torch.tensor([1e-3, -1e-3, 1e-3], dtype=torch.float64)
    found = joint_deviations(arm, commanded, measured, max_condition=100.0)
    assert found.usable.tolist() == [True, False, True]
    assert found.reasons["condition"].tolist() == [False, True, False]
    assert float(found.deviation[1].abs().max()) > 10 * float(found.deviation[0].abs().max())
    (note,) = found.notes()
    assert note.startswith("1 row is not trained on: the arm is near a singularity") and note.endswith("(row 2)")
    bound = joint_deviations(arm, commanded, measured, max_condition=1e9, max_deviation=0.02)
    assert bound.reasons["deviation"].tolist() == [False, True, False]
    damped = joint_deviations(arm, commanded, measured, max_condition=1e9, damping=0.01)
    error = arm.pose_error(measured[1], arm.forward_kinematics(commanded[1]))
    assert (
        damped.usable.all()
        and float(damped.deviation[1].norm()) <= float(error.position + 0.04 * error.rotation) / 0.02
    )


def test_unreachable_rows_are_flagged_and_finite():
    tripod = Tripod()
    pose = torch.tensor([[0.0, 0.5, 0.0], [0.0, 1.2, 0.0]], dtype=torch.float64)
    commanded = tripod.solve_inverse(pose[:1]).repeat(2, 1)
    found = joint_deviations(tripod, commanded, pose)
    assert found.usable.tolist() == [True, False] and found.reasons["unreachable"].tolist() == [False, True]
    assert torch.isfinite(found.deviation).all()


def test_what_joints_cannot_explain_is_the_remainder(tmp_path):
    """A SCARA cannot tilt its platform: a measured tilt stays, and the position is met all the same."""
    arm = make("scara", tmp_path)
    commanded = arm.sample_joints(20, torch.Generator().manual_seed(2))
    measured = arm.forward_kinematics(commanded)
    tilted = measured + torch.tensor([0, 0, 0, 0, 0, 1e-3], dtype=torch.float64)
    found = joint_deviations(arm, commanded, tilted)
    error = arm.pose_error(tilted, measured)
    assert (found.remainder_rotation <= error.rotation + 1e-12).all()
    assert float(found.remainder_rotation.min()) > 1e-4


def test_revolute_deviations_are_wrapped(tmp_path):
    arm = make("ur10_positions", tmp_path)
    commanded = arm.home_joints[None] + 2 * torch.pi
    found = joint_deviations(arm, commanded, arm.forward_kinematics(arm.home_joints[None] + 1e-4))
    assert float(found.deviation.abs().max()) < 1e-3
