"""The forward-calibration residual on serial arms and on parallel mechanisms."""

from __future__ import annotations

import math

import pytest
import torch
from linkages import measured
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    ParameterChoice,
    forward_problem,
    inverse_problem,
    solve_lm,
    what_is_known,
)
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

HALF = math.pi / 2
LINKS = [
    [0.1, HALF, 0.4, 0.0],
    [-0.5, 0, 0.0, 0.0],
    [-0.4, 0, 0, 0],
    [0, HALF, 0.12, 0],
    [0, -HALF, 0.1, 0],
    [0, 0, 0.09, 0],
]
NOISE = [2e-5] * 3 + [5e-5] * 3


def arm() -> SerialArm:
    return SerialArm(name="six", convention="standard", links=LINKS, limits=[(-2.0, 2.0)] * 6)


def poses(count: int, seed: int) -> tuple[SerialArm, Tensor, Tensor, Tensor]:
    """Arm, parameters as built, joints, and poses with noise about the axes of the measuring frame."""
    generator = torch.Generator().manual_seed(seed)
    six = arm()
    truth = six.nominal + 5e-4 * torch.randn(six.nominal.shape, generator=generator, dtype=torch.float64)
    joints = six.sample_joints(count, generator)
    pose = six.forward_kinematics(joints, truth)
    noise = torch.tensor(NOISE) * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    turned = rotation_vector_to_matrix(noise[:, 3:]) @ rotation_vector_to_matrix(pose[:, 3:])
    return six, truth, joints, torch.cat([pose[:, :3] + noise[:, :3], matrix_to_rotation_vector(turned)], dim=-1)


def test_at_the_truth_the_residual_of_an_arm_is_white() -> None:
    six, truth, joints, pose = poses(1500, 1)
    generator = torch.Generator().manual_seed(3)
    read = joints + 1e-4 * torch.randn(joints.shape, generator=generator, dtype=torch.float64)
    for q, joint_noise in ((joints, None), (read, 1e-4)):
        problem = forward_problem(six, q, pose, pose_noise=NOISE, joint_noise=joint_noise)
        residual = problem.residual(truth.expand(1, len(pose), -1), *problem.data)[0]
        spread = torch.cov(residual.mT)
        torch.testing.assert_close(spread, torch.eye(6, dtype=torch.float64), rtol=0, atol=5 * (2 / 1500) ** 0.5)


def test_what_an_arm_cannot_tell_is_named() -> None:
    """Two frames, three parallel axes: the eight directions that textbooks name."""
    six, truth, joints, pose = poses(60, 2)
    problem = forward_problem(six, joints, pose, pose_noise=NOISE)
    fit = solve_lm(problem)
    assert bool(fit.converged.all())
    known = what_is_known(problem, fit.values)
    assert set(known.combinations) == {
        "base_z and d1 only as 1.00 base_z + 1.00 d1",
        "base_rz and theta1 only as 1.00 base_rz + 1.00 theta1",
        "d2, d3 and d4 only as 1.00 d2 + 1.00 d3 + 1.00 d4",
        "a6 and tool_x only as 1.00 a6 + 1.00 tool_x",
        "alpha6 and tool_rx only as 1.00 alpha6 + 1.00 tool_rx",
        "d6 and tool_z only as 1.00 d6 + 1.00 tool_z",
        "theta6 and tool_rz only as 1.00 theta6 + 1.00 tool_rz",
    }
    assert int(known.rank) == len(truth) - 8


def test_an_arm_is_identified_where_it_can_be() -> None:
    six, truth, joints, pose = poses(60, 2)
    choice = ParameterChoice(fixed=["d1", "theta1", "d3", "d4", "tool_*"])
    start = truth.clone()
    free = [i for i, p in enumerate(six.geometry) if p.name not in ("d1", "theta1", "d3", "d4")]
    free = [i for i in free if not six.geometry[i].name.startswith("tool_")]
    start[free] = six.nominal[free]
    problem = forward_problem(six, joints, pose, choice=choice, pose_noise=NOISE, start=start)
    fit = solve_lm(problem)
    known = what_is_known(problem, fit.values)
    assert known.combinations == ()
    off = (fit.values[0] - truth[free]) / known.sd[0]
    assert float(off.abs().max()) < 4.5
    assert abs(float(known.noise) - 1) < 0.2


def test_without_noise_given_angles_are_weighed_in_metres() -> None:
    six, _, joints, pose = poses(20, 4)
    problem = forward_problem(six, joints, pose, rotation_weight=0.5)
    residual = problem.residual(problem.start[:, None].expand(1, 20, -1), *problem.data)[0]
    there, turned = six.forward_frame(joints)
    apart = six.pose_error(six.forward_kinematics(joints), pose)
    torch.testing.assert_close(residual[:, :3], there - pose[:, :3], rtol=0, atol=1e-12)
    assert apart.rotation is not None
    torch.testing.assert_close(residual[:, 3:].norm(dim=-1), 0.5 * apart.rotation, rtol=1e-6, atol=1e-12)
    assert not problem.noise_known
    assert turned.shape == (20, 3, 3)


def test_forward_and_inverse_calibration_agree() -> None:
    """Both are the maximum of one likelihood, to first order in noise and errors (the noise is carried nominally)."""
    rows = measured(3, 36, 5, noise=1e-6)
    forward = forward_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=1e-6)
    inverse = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=1e-6)
    first, second = solve_lm(forward), solve_lm(inverse)
    sd = what_is_known(inverse, second.values).sd
    torch.testing.assert_close(sd, what_is_known(forward, first.values).sd, rtol=5e-2, atol=0)
    assert float(((first.values - second.values) / sd).abs().max()) < 0.2


def test_angles_of_other_names_wrap() -> None:
    tripod = load_mechanism("tripod")
    joints = tripod.sample_joints(8, torch.Generator().manual_seed(0))
    pose = tripod.forward_kinematics(joints)
    pose[:, 2] += 2 * math.pi
    problem = forward_problem(tripod, joints, pose, pose_noise=1e-5)
    assert [c.name for c in problem.channels] == ["y", "z", "phi"]
    assert float(problem.residual(problem.start[:, None].expand(1, 8, -1), *problem.data).abs().max()) < 1e-6


def test_joints_that_do_not_close_are_named() -> None:
    rows = measured(1, 8, 6)
    joints = rows.joints[0].clone()
    joints[2] = torch.tensor([math.pi, 0.0])
    with pytest.raises(InputError, match=r"row 3: five_bar with its starting geometry is out of reach at q1 = 3.14159"):
        forward_problem(rows.mechanism, joints, rows.pose[0])
