"""Gough-Stewart platform and delta robots against naive twins and a root finder that is not ours."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from ccnn_torch.mechanisms import Stewart, load_mechanism
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import rotation_vector_rate, rotation_vector_to_matrix

PARALLEL = ("five_bar", "overconstrained_2dof", "stewart", "delta", "delta_linear")


def _disturbed(mechanism, seed=0):
    """Parameters of a machine as built: each off by a draw of its plausible size."""
    off = torch.randn(len(mechanism.geometry), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return mechanism.nominal + 2e-3 * off


def _named(mechanism, values):
    return dict(zip([g.name for g in mechanism.geometry], values.tolist(), strict=True))


def _stewart(q, pose, p):
    rotation = Rotation.from_rotvec(pose[3:]).as_matrix()
    residual = []
    for i in range(1, 7):
        on_base, on_platform = (np.array([p[f"{letter}{i}{c}"] for c in "xyz"]) for letter in "BP")
        length = p[f"gain{i}"] * q[i - 1] + p[f"offset{i}"]
        residual.append(np.linalg.norm(pose[:3] + rotation @ on_platform - on_base) - length)
    return np.array(residual)


def _delta(q, pose, p):
    residual = []
    for i in range(1, 4):
        outward = np.array([math.cos(p[f"angle{i}"]), math.sin(p[f"angle{i}"]), 0.0])
        turned = q[i - 1] + p[f"offset{i}"]
        elbow = (p[f"base{i}"] + p[f"crank{i}"] * math.cos(turned)) * outward
        elbow[2] -= p[f"crank{i}"] * math.sin(turned)
        residual.append(np.linalg.norm(pose + p[f"platform{i}"] * outward - elbow) - p[f"rod{i}"])
    return np.array(residual)


def _delta_linear(q, pose, p):
    residual = []
    for i in range(1, 4):
        lean, skew = p[f"lean{i}"], p[f"skew{i}"]
        in_leg = [math.sin(lean) * math.cos(skew), math.sin(skew), math.cos(lean) * math.cos(skew)]
        turn = Rotation.from_euler("z", p[f"angle{i}"]).as_matrix()
        carriage = turn @ (np.array([p[f"base{i}"], 0, 0]) + (q[i - 1] + p[f"offset{i}"]) * np.array(in_leg))
        joint = pose + turn @ np.array([p[f"platform{i}"], 0, 0])
        residual.append(np.linalg.norm(joint - carriage) - p[f"rod{i}"])
    return np.array(residual)


CLOSURES = {"stewart": _stewart, "delta": _delta, "delta_linear": _delta_linear}


@pytest.mark.parametrize("name", CLOSURES)
def test_kinematics_against_a_naive_closure_and_scipy(name):
    mechanism, closure = load_mechanism(name), CLOSURES[name]
    values = _disturbed(mechanism)
    named = _named(mechanism, values)
    poses = mechanism.sample_workspace(12, torch.Generator().manual_seed(1))
    joints = mechanism.solve_inverse(poses, values)
    there = mechanism.forward_kinematics(joints, values)
    torch.testing.assert_close(there, poses, rtol=0, atol=1e-12)
    for q, pose in zip(joints.numpy(), poses.numpy(), strict=True):
        assert np.abs(closure(q, pose, named)).max() < 1e-14
        backward = root(closure, q + 0.01, args=(pose, named), tol=1e-13)
        np.testing.assert_allclose(backward.x, q, atol=1e-10)
        forward = root(lambda x, q=q: closure(q, x, named), mechanism.home_pose.numpy(), tol=1e-13)
        np.testing.assert_allclose(forward.x, pose, atol=1e-9)


def test_delta_hangs_with_its_cranks_outward():
    delta = load_mechanism("delta")
    poses = delta.sample_workspace(500, torch.Generator().manual_seed(2))
    joints = delta.solve_inverse(poses)
    assert float(poses[:, 2].max()) < 0 and float(torch.cos(joints).min()) > 0
    # On the axis, cranks level: the platform hangs where the rod and the radii say.
    level = delta.forward_kinematics(torch.zeros(3, dtype=torch.float64))
    expected = [0.0, 0.0, -math.sqrt(0.55**2 - (0.2 + 0.25 - 0.05) ** 2)]
    torch.testing.assert_close(level, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-14)


def test_a_delta_of_other_dimensions_is_sampled_where_it_works():
    """Cranks from a little above level downwards; a picker has its platform 0.7 to 0.95 m below the motors."""
    picker = load_mechanism("delta", base=0.2, crank=0.35, platform=0.06, rod=0.8)
    level = picker.forward_kinematics(torch.zeros(3, dtype=torch.float64))[2]
    joints = picker.sample_joints(200, torch.Generator().manual_seed(2))
    assert picker.low[2] < -0.9 and picker.high[2] < level
    assert joints.min() > -0.4 and joints.max() < 1.2
    assert load_mechanism("delta").low.tolist() == [-0.15, -0.15, -0.6]


def test_radii_of_a_delta_act_by_their_difference_only():
    for name in ("delta", "delta_linear"):
        delta = load_mechanism(name)
        names = [g.name for g in delta.geometry]
        both = delta.nominal.clone()
        both[names.index("base2")] += 0.01
        both[names.index("platform2")] += 0.01
        poses = delta.sample_workspace(20, torch.Generator().manual_seed(3))
        torch.testing.assert_close(delta.solve_inverse(poses, both), delta.solve_inverse(poses), rtol=0, atol=1e-14)


def test_linear_delta_with_leaning_rails_is_level_at_the_same_height():
    """Rails that lean by 90° are a level star: the carriages then stand at the radius that the rods ask for."""
    star = load_mechanism("delta_linear", lean=math.pi / 2, base=0.0)
    pose = torch.tensor([0.0, 0.0, -0.4], dtype=torch.float64)
    expected = 0.05 + math.sqrt(0.6**2 - 0.4**2)
    torch.testing.assert_close(
        star.solve_inverse(pose), torch.full((3,), expected, dtype=torch.float64), rtol=0, atol=1e-14
    )


def test_stewart_keeps_its_assembly_mode():
    stewart = load_mechanism("stewart")
    assert bool(stewart.reachable(stewart.home_pose))
    flipped = stewart.home_pose * torch.tensor([1, 1, -1, 1, 1, 1], dtype=torch.float64)
    # The mirror image has the same leg lengths, on the other assembly mode.
    torch.testing.assert_close(stewart.solve_inverse(flipped), stewart.home_joints)
    assert not bool(stewart.reachable(flipped))
    box = stewart.low + (stewart.high - stewart.low) * torch.rand(500, 6, generator=torch.Generator().manual_seed(4))
    back = stewart.forward_kinematics(stewart.solve_inverse(box))
    torch.testing.assert_close(back, box, rtol=0, atol=1e-9)


def test_a_description_keeps_the_box_of_a_higher_stewart():
    stewart = load_mechanism("stewart", height=0.9)
    twin = stewart.with_nominal(stewart.nominal)
    assert twin.describe()["keys"] == {"height": 0.9} and float(twin.home_pose[2]) == 0.9


# A pose without joints and joints without a pose; a Gough-Stewart platform has legs for every pose, and the three rods
# of a delta robot with its proportions always meet.
WITHOUT_SOLUTION = {
    "five_bar": ([0.0, 3.0], [math.pi, 0.0]),
    "overconstrained_2dof": ([0.0, 3.0], [1.5, 1.5]),
    "stewart": (None, [0.1, 3.0, 0.1, 3.0, 0.1, 3.0]),
    "delta": ([5.0, 5.0, 5.0], None),
    "delta_linear": ([5.0, 5.0, 5.0], [-2.0, 0.0, 2.0]),
}


@pytest.mark.parametrize("name", PARALLEL)
def test_rows_without_a_solution_do_not_spoil_the_gradient_of_the_others(name):
    mechanism = load_mechanism(name)
    poses = mechanism.sample_workspace(4, torch.Generator().manual_seed(5))
    joints = mechanism.solve_inverse(poses)
    out_of_reach, jammed = WITHOUT_SOLUTION[name]
    for verb, fine, wrong in (("solve_inverse", poses, out_of_reach), ("forward_kinematics", joints, jammed)):
        if wrong is None:
            continue
        call, wrong = getattr(mechanism, verb), torch.tensor(wrong, dtype=torch.float64)
        values = mechanism.nominal.clone().requires_grad_()
        out = call(torch.cat([fine, wrong[None]]), values)
        assert torch.isnan(out[-1]).any() and torch.isfinite(out[:-1]).all()
        out[:-1].sum().backward()
        alone = mechanism.nominal.clone().requires_grad_()
        call(fine, alone).sum().backward()
        torch.testing.assert_close(values.grad, alone.grad, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", PARALLEL)
def test_a_parameter_of_a_leg_moves_its_joint_alone(name):
    """What divide and conquer relies on: ∂q_i/∂p = 0 for every parameter p of another leg."""
    mechanism = load_mechanism(name)
    poses = mechanism.sample_workspace(20, torch.Generator().manual_seed(6))
    slope = jacobian_of(lambda v: mechanism.solve_inverse(poses, v), mechanism.nominal.expand(20, -1))[1]
    legs = [g.leg for g in mechanism.geometry]
    assert {leg for leg in legs if leg is not None} == set(range(1, len(mechanism.joints) + 1))
    for i in range(len(mechanism.joints)):
        others = [k for k, leg in enumerate(legs) if leg not in (None, i + 1)]
        own = [k for k, leg in enumerate(legs) if leg == i + 1]
        assert not slope[:, i, others].any()
        assert (slope[:, i, own].abs().amax(0) > 0).all()


def test_rate_of_a_rotation_vector():
    """The left Jacobian against central differences of the matrix, down to no rotation."""
    axis = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64)
    for angle in (0.0, 1e-5, 9e-4, 1.1e-3, 0.5, 3.0):
        vector = angle * axis
        rate = rotation_vector_rate(vector)
        for i in range(3):
            step = torch.zeros(3, dtype=torch.float64)
            step[i] = 1e-6
            ahead, behind = rotation_vector_to_matrix(vector + step), rotation_vector_to_matrix(vector - step)
            spin = (ahead - behind) / 2e-6 @ rotation_vector_to_matrix(vector).mT
            found = torch.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
            torch.testing.assert_close(rate[:, i], found, rtol=0, atol=1e-8)


def test_a_platform_with_drives_of_another_kind_has_them_both_ways():
    class Bent(Stewart):
        def solve_inverse(self, pose, parameters=None, guess=None):
            return super().solve_inverse(pose, parameters, guess) + 0.01 * pose[..., :1] ** 2

    bent = Bent()
    pose = bent.sample_workspace(20, torch.Generator().manual_seed(3))
    reached = bent.forward_kinematics(bent.solve_inverse(pose))
    torch.testing.assert_close(reached, pose, rtol=0, atol=1e-9)
