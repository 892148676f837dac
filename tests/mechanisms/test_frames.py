"""Base and tool frames recovered from measured poses."""

import numpy as np
import pytest
import torch
from catalogue import PANDA, UR10, make

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import fit_frames, read_dh_file
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.pseudoerror import joint_deviations


def _random_frames(generator):
    """Frames anywhere: up to 3 m away, turned by any angle."""
    turn = matrix_to_rotation_vector(
        rotation_vector_to_matrix(6 * torch.rand(2, 3, generator=generator, dtype=torch.float64) - 3)
    )
    place = torch.tensor([[3.0], [0.3]], dtype=torch.float64) * (
        2 * torch.rand(2, 3, generator=generator, dtype=torch.float64) - 1
    )
    return torch.cat([place, turn], dim=-1).flatten()


def _measured(arm, frames, joints, noise, generator):
    values = arm.nominal.clone()
    values[:6], values[-6:] = frames[:6], frames[6:]
    pose = arm.forward_kinematics(joints, values)
    scale = torch.tensor([1.0, 1.0, 1.0, 3.0, 3.0, 3.0], dtype=torch.float64)[: pose.shape[-1]]
    return pose + noise * scale * torch.randn(pose.shape, generator=generator, dtype=torch.float64), values


@pytest.mark.parametrize("name", ["ur10", "ur10_positions", "urdf"])
@pytest.mark.parametrize("seed", range(5))
def test_exact_data_gives_the_frames(name, seed, tmp_path):
    arm, generator = make(name, tmp_path), torch.Generator().manual_seed(seed)
    joints = arm.sample_joints(40, generator)
    pose, truth = _measured(arm, _random_frames(generator), joints, 0.0, generator)
    fitted = fit_frames(arm, joints, pose)
    error = arm.pose_error(arm.forward_kinematics(joints, fitted), arm.forward_kinematics(joints, truth))
    assert float(error.position.max()) < 1e-9
    torch.testing.assert_close(fitted[6:-6], arm.nominal[6:-6], rtol=0, atol=0)
    torch.testing.assert_close(fitted[-6:-3], truth[-6:-3], rtol=0, atol=1e-8)
    for got, expected in ((fitted[3:6], truth[3:6]),):
        turn = rotation_vector_to_matrix(got) @ rotation_vector_to_matrix(expected).mT
        assert float(matrix_to_rotation_vector(turn).abs().max()) < 1e-8


def test_noise_averages_out_and_repeats_keep_to_their_rows(tmp_path):
    """0.1 mm of noise: 200 rows give the frames to a few hundredths; a repeat equals the fit of its rows alone."""
    arm, generator = make("ur10", tmp_path), torch.Generator().manual_seed(3)
    joints = arm.sample_joints(200, generator)
    pose, truth = _measured(arm, _random_frames(generator), joints, 1e-4, generator)
    weights = (torch.rand(4, 200, generator=generator) > 0.3).double()
    pose_bad = pose.clone()
    pose_bad[weights[0] == 0] += 0.3
    fitted = fit_frames(arm, joints, pose_bad, weights)
    assert fitted.shape == (4, 36)
    alone = fit_frames(arm, joints[weights[0] > 0], pose[weights[0] > 0])
    torch.testing.assert_close(fitted[0], alone, rtol=0, atol=1e-9)
    error = arm.pose_error(arm.forward_kinematics(joints, alone), arm.forward_kinematics(joints, truth))
    assert float(error.position.max()) < 6e-5 and float(error.rotation.max()) < 2e-4


def test_the_fit_is_a_minimum(tmp_path):
    """No small move of any frame parameter lowers the weighted cost."""
    arm, generator = make("ur10", tmp_path), torch.Generator().manual_seed(4)
    joints = arm.sample_joints(60, generator)
    pose, _ = _measured(arm, _random_frames(generator), joints, 1e-3, generator)
    fitted = fit_frames(arm, joints, pose, rotation_weight=0.3)

    def cost(values):
        error = arm.pose_error(pose, arm.forward_kinematics(joints, values))
        return float(error.position.square().sum() + 0.09 * error.rotation.square().sum())

    best = cost(fitted)
    for i in (*range(6), *range(30, 36)):
        for step in (-1e-5, 1e-5):
            moved = fitted.clone()
            moved[i] += step
            assert cost(moved) > best


def test_known_frames_stay(tmp_path):
    generator = torch.Generator().manual_seed(5)
    path = tmp_path / "arm.yaml"
    path.write_text(UR10.replace("tool_frame: unknown", "tool_frame: [10, 20, 30, 0.1, 0.2, 0.3]"))
    arm = read_dh_file(str(path))
    frames = _random_frames(generator)
    frames[6:] = arm.nominal[-6:]
    joints = arm.sample_joints(30, generator)
    pose, truth = _measured(arm, frames, joints, 0.0, generator)
    fitted = fit_frames(arm, joints, pose)
    assert torch.equal(fitted[-6:], arm.nominal[-6:])
    error = arm.pose_error(arm.forward_kinematics(joints, fitted), arm.forward_kinematics(joints, truth))
    assert float(error.position.max()) < 1e-9
    known = make("panda", tmp_path)
    assert torch.equal(fit_frames(known, known.home_joints[None], known.home_pose[None]), known.nominal)


def test_refusals(tmp_path):
    arm = make("ur10", tmp_path)
    joints = arm.sample_joints(2, torch.Generator().manual_seed(0))
    with pytest.raises(InputError, match="at least 3 training rows, got 2"):
        fit_frames(arm, joints, arm.forward_kinematics(joints))
    panda, columns = _panda_with_groups(tmp_path), {"robot": np.zeros(2), "placement": np.zeros(2)}
    joints = panda.sample_joints(2, torch.Generator().manual_seed(0))
    pose = panda.forward_kinematics(joints)
    with pytest.raises(InputError, match="frame_per names the column 'placement', which the records lack"):
        fit_frames(panda, joints, pose, columns={"robot": columns["robot"]})
    with pytest.raises(InputError, match="robot 0, placement 0: a frame needs at least 3 training rows, got 2"):
        fit_frames(panda, joints, pose, columns=columns)


def _panda_with_groups(folder):
    path = folder / "arm.yaml"
    text = PANDA.replace("base_frame: identity", "base_frame: unknown") + "tool_offset: unknown\n"
    path.write_text(text + "frame_per: [robot, placement]\ntool_per: [robot]\n")
    return read_dh_file(str(path), orientation="none")


def test_frames_per_group(tmp_path):
    """Two robots with tools of their own, five plates: a base frame per plate, the tool shared by a robot's plates."""
    arm, generator = _panda_with_groups(tmp_path), torch.Generator().manual_seed(6)
    robot = torch.tensor([0, 0, 0, 1, 1]).repeat_interleave(20)
    placement = torch.tensor([0, 1, 2, 0, 7]).repeat_interleave(20)
    joints = arm.sample_joints(100, generator)
    truth = arm.nominal.repeat(100, 1)
    for group in range(5):
        truth[20 * group : 20 * group + 20, :6] = _random_frames(generator)[:6]
    truth[:, -6:-3] = torch.tensor([[0.01, 0.02, 0.137], [-0.03, 0.0, 0.12]], dtype=torch.float64)[robot]
    pose = arm.forward_kinematics(joints, truth)
    weights = (torch.rand(2, 100, generator=generator) > 0.3).double()
    bad = pose.clone()
    bad[weights[0] == 0] += 0.2
    columns = {"robot": robot.double().numpy(), "placement": placement.double().numpy()}
    fitted = fit_frames(arm, joints, bad, weights[:1], columns=columns)
    assert fitted.shape == (1, 100, len(arm.geometry))
    error = arm.pose_error(arm.forward_kinematics(joints, fitted[0]), pose)
    assert float(error.position.max()) < 1e-8
    torch.testing.assert_close(fitted[0, :, -6:-3], truth[:, -6:-3], rtol=0, atol=1e-8)
    found = joint_deviations(arm, joints, pose, fitted)
    assert found.deviation.shape == (1, 100, 7) and float(found.deviation.abs().max()) < 1e-7
