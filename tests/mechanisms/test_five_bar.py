"""The five-bar against its printed equations, a root finder that is not ours, and a drawn workspace."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import root

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import FiveBar, load_mechanism

# Table 2, "disturbed (real) parameters", in the order of `FiveBar.geometry`.
REAL = torch.tensor(
    [0.7478, 1.1006, -0.5057, 0.0060, 1.0041, 6.4e-4, 0.7417, 1.1014, 0.5059, -1.9e-4, 1.0045, 0.0046],
    dtype=torch.float64,
)


def _inner(bar, count, share=0.95, seed=0):
    """Poses well inside the circle, so that a disturbed machine reaches them too."""
    centre, _ = bar.maximal_inscribed_circle()
    return centre + share * (bar.sample_workspace(count, torch.Generator().manual_seed(seed)) - centre)


def _equations_9_and_12(q, pose, values):
    """Residual of eq. 12 of both legs, the cranks' angles by eq. 9; the second line's l_1 read as l_2."""
    residual = []
    for leg in range(2):
        l, L, ax, ay, k, gamma = values[6 * leg : 6 * leg + 6]
        psi = k * q[0] + gamma if leg == 0 else math.pi - (k * (math.pi - q[1]) + gamma)
        across, up = pose[0] - l * math.cos(psi) - ax, pose[1] - l * math.sin(psi) - ay
        residual.append(across**2 + up**2 - L**2)
    return np.array(residual)


@pytest.mark.parametrize("values", [FiveBar().nominal, REAL], ids=["nominal", "real"])
def test_inverse_and_forward_kinematics_solve_the_printed_equations(values):
    bar = FiveBar()
    poses = _inner(bar, 30)
    joints = bar.solve_inverse(poses, values)
    there = bar.forward_kinematics(joints, values)
    torch.testing.assert_close(there, poses, rtol=0, atol=1e-12)
    for q, pose in zip(joints.tolist(), poses.tolist(), strict=True):
        assert np.abs(_equations_9_and_12(q, pose, values.tolist())).max() < 1e-14
        near = [q[0] + 0.05, q[1] - 0.05]
        theirs = root(_equations_9_and_12, near, args=(pose, values.tolist()), tol=1e-13)
        np.testing.assert_allclose(theirs.x, q, atol=1e-9)


def test_the_joints_are_the_cranks_angles_from_x():
    bar = FiveBar()
    # Level cranks outward put the elbows 2.5 m apart, farther than the couplers reach.
    assert torch.isnan(bar.forward_kinematics(torch.tensor([math.pi, 0.0], dtype=torch.float64))).all()
    up = torch.tensor([math.pi / 2, math.pi / 2], dtype=torch.float64)
    expected = torch.tensor([0.0, 0.75 + math.sqrt(1.1**2 - 0.5**2)], dtype=torch.float64)
    torch.testing.assert_close(bar.forward_kinematics(up), expected, rtol=0, atol=1e-14)


def test_a_mirrored_machine_has_mirrored_joints():
    bar = FiveBar()
    poses = _inner(bar, 50)
    joints = bar.solve_inverse(poses)
    mirrored = bar.solve_inverse(poses * torch.tensor([-1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(mirrored, math.pi - joints.flip(-1), rtol=0, atol=1e-13)


def test_elbows_point_outward_over_the_whole_circle():
    bar = FiveBar()
    poses = bar.sample_workspace(3000, torch.Generator().manual_seed(1))
    q = bar.solve_inverse(poses)
    elbow = torch.stack([torch.cos(q), torch.sin(q)], dim=-1) * 0.75 + torch.tensor([[-0.5, 0.0], [0.5, 0.0]]).double()
    foot = torch.tensor([[-0.5, 0.0], [0.5, 0.0]], dtype=torch.float64)
    to_tool, crank = poses[:, None] - foot, elbow - foot
    side = to_tool[..., 0] * crank[..., 1] - to_tool[..., 1] * crank[..., 0]
    assert (side[:, 0] > 0).all() and (side[:, 1] < 0).all()
    # Continuous joints: neighbours in pose are neighbours in the joints, with no turn in between.
    apart = torch.cdist(poses, poses)
    apart.fill_diagonal_(torch.inf)
    near = apart.argmin(-1)
    assert float((q - q[near]).abs().max()) < 1.5


def _regular(bar, poses):
    """Reached on the nominal branch, and no leg or pair of couplers in line."""
    joints = bar.solve_inverse(poses)
    return bar.reachable(poses) & torch.isfinite(bar.condition_number(joints))


@pytest.mark.parametrize("values", [None, REAL], ids=["nominal", "real"])
def test_inscribed_circle_is_free_of_singularities_and_maximal(values):
    bar = FiveBar() if values is None else FiveBar().with_nominal(values)
    centre, radius = bar.maximal_inscribed_circle()
    turn = torch.linspace(0, 2 * math.pi, 361, dtype=torch.float64)
    around = torch.stack([torch.cos(turn), torch.sin(turn)], dim=-1)
    shares = torch.linspace(0.01, 0.9999, 20, dtype=torch.float64)[:, None, None]
    disc = (centre + radius * shares * around).reshape(-1, 2)
    assert _regular(bar, disc).all()
    # Between the rays and the rings no singularity hides: the determinant never changes its sign.
    jacobian = bar.jacobian(bar.solve_inverse(disc))[..., :2, :]
    assert (torch.linalg.det(jacobian) < 0).all() or (torch.linalg.det(jacobian) > 0).all()
    # Maximal: no neighbouring centre admits a circle that is larger by a thousandth of a millimetre.
    steps = torch.cartesian_prod(*[torch.linspace(-0.02, 0.02, 5, dtype=torch.float64)] * 2)
    for step in steps:
        rim = centre + step + (radius + 1e-3) * around
        assert not _regular(bar, rim).all()


def test_inscribed_circle_touches_what_bounds_it():
    """Both outer circles of reach, and below the pose with the couplers stretched on the axis of symmetry."""
    centre, radius = FiveBar().maximal_inscribed_circle()
    outer = 0.75 + 1.1 - math.hypot(0.5, float(centre[1]))
    lowest = math.sqrt(0.75**2 - 0.6**2)  # elbows 2.2 m apart at the height of the tool
    assert float(centre[0]) == pytest.approx(0, abs=1e-6)
    assert float(radius) == pytest.approx(outer, abs=1e-6)
    assert float(radius) == pytest.approx(float(centre[1]) - lowest, abs=1e-6)


def test_samples_fill_the_circle_evenly():
    bar = FiveBar()
    centre, radius = bar.maximal_inscribed_circle()
    away = (bar.sample_workspace(20000, torch.Generator().manual_seed(2)) - centre).norm(dim=-1) / radius
    assert float(away.max()) < 1
    share = (away[:, None] < torch.tensor([0.25, 0.5, 0.75]).double()).double().mean(0)
    torch.testing.assert_close(share, torch.tensor([0.0625, 0.25, 0.5625]).double(), rtol=0, atol=0.012)


def test_keys_and_refusals():
    bar = load_mechanism("five_bar", l=0.3, L=0.5, a=0.1)
    assert [g.name for g in bar.geometry] == [f"{n}{i}{c}" for i in (1, 2) for n, c in _PARTS]
    assert [g.leg for g in bar.geometry] == [1] * 6 + [2] * 6
    with pytest.raises(InputError, match="no pose has both elbows outward"):
        load_mechanism("five_bar", l=0.1, L=0.1, a=1.0)


_PARTS = (("l", ""), ("L", ""), ("A", "x"), ("A", "y"), ("k", ""), ("gamma", ""))
