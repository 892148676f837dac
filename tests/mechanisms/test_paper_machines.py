"""The two machines against the paper's printed equations and a root finder that is not ours."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from ccnn_torch.mechanisms import MachineTool, Tripod, mechanism_from_description
from ccnn_torch.numerics.least_squares import jacobian_of


def _poses(mechanism, count=40, seed=0):
    return mechanism.sample_workspace(count, torch.Generator().manual_seed(seed))


def test_tripod_is_equation_15():
    tripod = Tripod()
    L, r = 1.0, 0.3
    for pose in _poses(tripod):
        y, z, phi = pose.tolist()
        expected = (
            math.sqrt(L**2 - y**2 - (z + r * math.sin(phi)) ** 2) + r * math.cos(phi),
            math.sqrt(L**2 - y**2 - (z - r * math.sin(phi)) ** 2) + r * math.cos(phi),
            math.sqrt(L**2 - z**2) + y + r,
        )
        assert tripod.solve_inverse(pose).tolist() == pytest.approx(expected, abs=1e-15)


def _equation_18(pose, u, l_e=0.2, l_b=0.7, z_0=0.1, l=0.6, gamma=math.pi / 4):
    tx, ty, z = pose
    left = []
    for i, angle in enumerate((90, 210, 330)):
        a = b = math.radians(angle)
        x = l_e * math.cos(b) * math.cos(ty) + z_0 * math.sin(ty) - (l_b - u[i] * math.cos(gamma)) * math.cos(a)
        y = l_e * math.cos(b) * math.sin(tx) * math.sin(ty) + l_e * math.sin(b) * math.cos(tx)
        y += -z_0 * math.sin(tx) * math.cos(ty) - (l_b - u[i] * math.cos(gamma)) * math.sin(a)
        h = -l_e * math.cos(b) * math.cos(tx) * math.sin(ty) + l_e * math.sin(b) * math.sin(tx) + z
        h += z_0 * math.cos(tx) * math.cos(ty) - u[i] * math.sin(gamma)
        left.append(x**2 + y**2 + h**2 - l**2)
    return left


def test_machine_tool_solves_equation_18_with_the_smaller_root():
    machine = MachineTool()
    for pose in _poses(machine):
        u = machine.solve_inverse(pose).tolist()
        assert _equation_18(pose.tolist(), u) == pytest.approx([0, 0, 0], abs=1e-14)
        # The left side is a convex parabola in u_i: it falls at the smaller root.
        assert all(v < 0 for v in _equation_18(pose.tolist(), [v + 1e-3 for v in u]))


@pytest.mark.parametrize("kind", [Tripod, MachineTool])
def test_forward_kinematics_against_scipy(kind):
    machine = kind()
    joints = machine.solve_inverse(_poses(machine, 12))
    ours = machine.forward_kinematics(joints).numpy()
    for q, pose in zip(joints, ours, strict=True):
        theirs = root(
            lambda x, q=q: machine.closure(torch.from_numpy(x), q).numpy(), machine.home_pose.numpy(), tol=1e-12
        )
        assert np.abs(theirs.fun).max() < 1e-12
        np.testing.assert_allclose(pose, theirs.x, atol=1e-9)


def test_tripod_box_is_well_conditioned():
    """The grid of the case study: five values each, condition number of ∂ρ/∂X at most 11.5."""
    tripod = Tripod()
    axes = [torch.linspace(a, b, 5, dtype=torch.float64) for a, b in zip(*tripod.bounds, strict=True)]
    grid = torch.cartesian_prod(*axes)
    _, slope = jacobian_of(tripod.solve_inverse, grid)
    worst = float(torch.linalg.cond(slope).max())
    assert 11.0 < worst <= 11.5
    assert tripod.reachable(grid).all()


def test_tripod_newton_keeps_the_assembly_mode():
    """Far outside the sampling box Newton from home finds the same pose again, or says so; never another one."""
    tripod = Tripod()
    axes = [torch.linspace(*span, dtype=torch.float64) for span in ((-0.8, 0.8, 12), (0.02, 0.95, 12), (-1.4, 1.4, 12))]
    grid = torch.cartesian_prod(*axes)
    grid = grid[tripod.reachable(grid)]
    back = tripod.forward_kinematics(tripod.solve_inverse(grid))
    found = torch.isfinite(back).all(-1)
    assert len(grid) > 300 and found.double().mean() > 0.97
    torch.testing.assert_close(back[found], grid[found], rtol=0, atol=1e-8)


def test_unreachable_poses_are_named_and_nan():
    tripod = Tripod()
    pose = torch.tensor([[0.0, 0.5, 0.0], [0.9, 0.9, 0.0], [0.0, 0.01, -1.5]], dtype=torch.float64)
    assert tripod.reachable(pose).tolist() == [True, False, False]
    assert torch.isnan(tripod.solve_inverse(pose[1])[0])


def test_platform_frames_carry_the_legs():
    """The legs of both machines have their length when measured between the joints that `frame` puts in space."""
    tripod, machine = Tripod(), MachineTool()
    pose = _poses(tripod)
    rho = tripod.solve_inverse(pose)
    position, rotation = tripod.frame(pose)
    for side, joint in ((1.0, rho[:, 0]), (-1.0, rho[:, 1])):
        tip = position + rotation @ torch.tensor([side * 0.3, 0.0, 0.0], dtype=torch.float64)
        foot = torch.stack([side * joint, torch.zeros_like(joint), torch.zeros_like(joint)], dim=-1)
        torch.testing.assert_close((tip - foot).norm(dim=-1), torch.ones_like(joint), rtol=0, atol=1e-12)
    error = machine.pose_error(torch.tensor([0.1, 0.0, 0.6]).double(), torch.tensor([0.1, 1e-9, 0.6]).double())
    assert float(error.rotation) == pytest.approx(1e-9, rel=1e-6) and float(error.position) == 0.0


@pytest.mark.parametrize("kind", [Tripod, MachineTool])
def test_legs_of_their_own_are_the_common_ones_when_alike(kind):
    """Nominally the same joints bit by bit; one leg's parameters move one joint; the description keeps them."""
    common, own = kind(), kind(per_leg=True)
    poses = _poses(common)
    assert torch.equal(own.solve_inverse(poses), common.solve_inverse(poses))
    joints = own.solve_inverse(poses)
    torch.testing.assert_close(own.forward_kinematics(joints), poses, rtol=0, atol=1e-9)
    slope = jacobian_of(lambda v: own.solve_inverse(poses, v), own.nominal.expand(len(poses), -1))[1].abs().amax(0)
    moved = {(i + 1, g.leg) for k, g in enumerate(own.geometry) for i in range(3) if slope[i, k] > 0}
    assert moved == {(1, 1), (2, 2), (3, 3)}
    values = own.nominal + 1e-3 * torch.arange(len(own.nominal), dtype=torch.float64)
    twin = mechanism_from_description(own.with_nominal(values).describe())
    assert torch.equal(twin.nominal, values) and torch.equal(
        twin.solve_inverse(poses), own.solve_inverse(poses, values)
    )


def test_tripod_with_legs_of_their_own_is_equation_15_of_each():
    tripod = Tripod(per_leg=True)
    values = tripod.nominal + 1e-3 * torch.arange(9, dtype=torch.float64)
    (l1, r1, d1), (l2, r2, d2), (l3, r3, d3) = values.reshape(3, 3).tolist()
    for pose in _poses(tripod, 10):
        y, z, phi = pose.tolist()
        expected = (
            math.sqrt(l1**2 - y**2 - (z + r1 * math.sin(phi)) ** 2) + r1 * math.cos(phi) - d1,
            math.sqrt(l2**2 - y**2 - (z - r2 * math.sin(phi)) ** 2) + r2 * math.cos(phi) - d2,
            math.sqrt(l3**2 - z**2) + y + r3 - d3,
        )
        assert tripod.solve_inverse(pose, values).tolist() == pytest.approx(expected, abs=1e-15)


def test_machine_tool_with_legs_of_their_own_is_equation_18_of_each():
    machine = MachineTool(per_leg=True)
    values = machine.nominal + 1e-3 * torch.arange(24, dtype=torch.float64)
    names = ("l_e", "l_b", "z_0", "l", "gamma")
    named = dict(zip([g.name for g in machine.geometry], values.tolist(), strict=True))
    for pose in _poses(machine, 10):
        u = machine.solve_inverse(pose, values).tolist()
        for i in range(3):
            angles = named[f"alpha{i + 1}"], named[f"beta{i + 1}"]
            left = _equation_18_of_a_leg(
                pose.tolist(), u[i] + named[f"u_0{i + 1}"], angles, *(named[f"{n}{i + 1}"] for n in names)
            )
            assert left == pytest.approx(0, abs=1e-14)


def _equation_18_of_a_leg(pose, u, angles, l_e, l_b, z_0, l, gamma):
    rotation = Rotation.from_euler("XY", pose[:2]).as_matrix()
    a, b = angles
    joint = rotation @ [l_e * math.cos(b), l_e * math.sin(b), z_0] + [0, 0, pose[2]]
    reach = l_b - u * math.cos(gamma)
    carriage = np.array([reach * math.cos(a), reach * math.sin(a), u * math.sin(gamma)])
    return np.linalg.norm(joint - carriage) - l
