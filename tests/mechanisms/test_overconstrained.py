"""The over-constrained mechanism against the paper's printed equations and roots of its closure that are not ours."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Overconstrained2Dof, load_mechanism
from ccnn_torch.mechanisms.machines.closed_forms import crank_angle
from ccnn_torch.numerics.least_squares import jacobian_of

A, H, L, H_S = 0.150, 0.402, 0.317, 0.080
DEGREE = math.pi / 180
# Table 2, "predefined": ⁰δx, ⁰δy, ⁰δz [mm], ⁰δα, ⁰δγ [deg], Δl1, Δl2, ⁶δx, ⁶δy, ⁶δz [mm], Δθ [deg].
TABLE_2 = (
    (-1.5, 1.3, -1.0, 0.0, -0.1, 0.382, 1.214, 1.4, 1.3, 1.2, -0.28),
    (-1.0, -0.45, -1.5, 0.2, 0.2, -0.4, 0.5, 1.5, 2.0, 0.3, -0.4),
)
TO_SI = np.array([1e-3] * 3 + [DEGREE] * 2 + [1e-3] * 5 + [DEGREE])
ERRORS = np.array(TABLE_2) * TO_SI


def _machine_of_table_2(**keys):
    machine = Overconstrained2Dof(**keys)
    values = machine.nominal.clone()
    values[4:] = torch.from_numpy(ERRORS.reshape(-1))
    return machine, values


def _poses(machine, count=40, seed=0):
    return machine.sample_workspace(count, torch.Generator().manual_seed(seed))


def _equation_4(phi, theta):
    sp, cp, st, ct = math.sin(phi), math.cos(phi), math.sin(theta), math.cos(theta)
    return np.array(
        [
            [cp**2 * ct + sp**2, sp * cp * ct - sp * cp, cp * st],
            [sp * cp * ct - sp * cp, sp**2 * ct + cp**2, sp * st],
            [-cp * st, -sp * st, ct],
        ]
    )


def _equation_7(phi, theta):
    return H * np.array([math.cos(phi) * math.sin(theta / 2), math.sin(phi) * math.sin(theta / 2), math.cos(theta / 2)])


def _crank_end(beta, limb, error):
    """B_j + Δb_j + (l + Δl1) w'_1, by turning the limb's axes one after the other."""
    dx, dy, dz, alpha, gamma, dl1 = error[:6]
    axes = Rotation.from_euler("z", limb * math.pi / 2)
    along = Rotation.from_euler("x", alpha) * Rotation.from_euler("z", gamma) * Rotation.from_euler("y", beta)
    return axes.apply([A + dx, dy, dz]) + (L + dl1) * axes.apply(along.apply([1.0, 0.0, 0.0]))


def _platform_joint(position, rotation, limb, error):
    """r' + R (a'_j + Δa_j), eqs. 10 and 11 in the axes of the limb."""
    dx, dy, dz = error[7:10]
    return position + rotation @ Rotation.from_euler("z", limb * math.pi / 2).apply([A + dx, dy, dz - H_S])


def _closure(beta, limb, error, position, rotation):
    """Eq. 12: length of the upper link less what it should be."""
    link = _platform_joint(position, rotation, limb, error) - _crank_end(beta, limb, error)
    return np.linalg.norm(link) - (L + error[6])


def _appendix(position, rotation, limb, error):
    """A, B, C as they are printed, a_10 read as a'_1."""
    dx, dy, dz, alpha, gamma, dl1, dl2, ax, ay, az, _ = error
    sa, ca, sg, cg = math.sin(alpha), math.cos(alpha), math.sin(gamma), math.cos(gamma)
    if limb == 0:
        l1, l2, l3 = np.array([A + dx, dy, dz]) - position - rotation @ np.array([A + ax, ay, az - H_S])
        a = 2 * (L + dl1) * (l1 * cg + l2 * ca * sg + l3 * sa * sg)
        b = 2 * (L + dl1) * (l2 * sa - l3 * ca)
    else:
        l1, l2, l3 = np.array([-dy, A + dx, dz]) - position - rotation @ np.array([-ay, A + ax, az - H_S])
        a = 2 * (L + dl1) * (-l1 * ca * sg + l2 * cg + l3 * sa * sg)
        b = 2 * (L + dl1) * (-l1 * sa - l3 * ca)
    return a, b, (L + dl1) ** 2 + l1**2 + l2**2 + l3**2 - (L + dl2) ** 2


@pytest.mark.parametrize("origin", ["surface", "joint"])
def test_closed_form_is_a_root_of_the_closure_and_the_printed_equation_13(origin):
    """Every sign: at poses of eqs. 4 and 7, with the errors of Table 2, in both limbs."""
    machine, values = _machine_of_table_2(origin=origin)
    poses = _poses(machine)
    joints = machine.solve_inverse(poses, values)
    for (phi, theta), q in zip(poses.tolist(), joints.tolist(), strict=True):
        rotation = _equation_4(phi, theta)
        position = _equation_7(phi, theta) + (H_S * rotation[:, 2] if origin == "surface" else 0.0)
        for limb in range(2):
            error = ERRORS[limb]
            beta = q[limb] + error[-1]
            root = brentq(_closure, beta - 0.1, beta + 0.1, (limb, error, position, rotation), xtol=1e-14)
            assert beta == pytest.approx(root, abs=1e-11)
            a, b, c = _appendix(position, rotation, limb, error)
            printed = 2 * math.atan((-b + math.sqrt(b**2 - c**2 + a**2)) / (c - a))
            assert math.remainder(beta - printed, 2 * math.pi) == pytest.approx(0, abs=1e-12)


def test_without_errors_equation_13_is_equation_6():
    """The nominal inputs of eqs. 5 to 7 have no h_s: that holds where h_s leads from the S joint to the surface."""
    machine = Overconstrained2Dof()
    poses = _poses(machine)
    for (phi, theta), q in zip(poses.tolist(), machine.solve_inverse(poses).tolist(), strict=True):
        rotation, centre = _equation_4(phi, theta), _equation_7(phi, theta)
        for limb in range(2):
            axes = Rotation.from_euler("z", limb * math.pi / 2)
            crank = axes.apply(Rotation.from_euler("y", q[limb]).apply([1.0, 0.0, 0.0]))
            gap = centre + rotation @ axes.apply([A, 0, 0]) - axes.apply([A, 0, 0]) - L * crank
            assert np.linalg.norm(gap) == pytest.approx(L, abs=1e-14)


def test_the_root_is_the_printed_one_wherever_it_is_real():
    """The form without a pole against 2 arctan(…), also near C = A, for both signs of the square root."""
    draw = torch.randn(3, 2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    a, b, c = draw
    real = a**2 + b**2 > c**2
    for side in (-1.0, 1.0):
        ours = crank_angle(a, b, c, side)
        assert torch.equal(torch.isfinite(ours), real)
        printed = 2 * torch.atan((-b - side * torch.sqrt(a**2 + b**2 - c**2)) / (c - a))
        off = torch.remainder(ours - printed + math.pi, 2 * math.pi) - math.pi
        # The quotient loses its digits near C = A.
        assert float(off[real].abs().max()) < 1e-8
    pole = crank_angle(torch.tensor(1.0).double(), torch.tensor(0.5).double(), torch.tensor(1.0).double(), -1.0)
    assert math.cos(float(pole)) + 0.5 * math.sin(float(pole)) + 1 == pytest.approx(0, abs=1e-15)


def test_forward_kinematics_returns_the_pose_up_to_the_reach():
    """Tilts up to 85°, from no tilt: "the moving platform can rotate within the range ±90°"."""
    for machine, values in ((Overconstrained2Dof(), None), _machine_of_table_2()):
        phi = torch.linspace(0, 2 * math.pi, 25, dtype=torch.float64)[:-1]
        poses = torch.cartesian_prod(phi, torch.linspace(0.01, 85 * DEGREE, 12, dtype=torch.float64))
        joints = machine.solve_inverse(poses, values)
        assert machine.reachable(poses, values).all()
        back = machine.forward_kinematics(joints, values)
        error = machine.pose_error(back, poses)
        assert float(error.position.max()) < 1e-9 and float(error.rotation.max()) < 1e-9
    level = machine.jacobian(Overconstrained2Dof().solve_inverse(torch.zeros(2, dtype=torch.float64)))
    assert torch.isfinite(level).all()


def test_frame_is_equation_4_and_its_pose_equation_17():
    machine = Overconstrained2Dof()
    poses = _poses(machine)
    position, rotation = machine.frame(poses)
    for (phi, theta), p, r in zip(poses.tolist(), position.numpy(), rotation.numpy(), strict=True):
        np.testing.assert_allclose(r, _equation_4(phi, theta), atol=1e-15)
        np.testing.assert_allclose(p, _equation_7(phi, theta) + H_S * r[:, 2], atol=1e-15)
    torch.testing.assert_close(machine.pose_near(position, rotation), poses, rtol=0, atol=1e-13)
    with pytest.raises(InputError, match="needs its rotation"):
        machine.pose_near(position, None)


def test_without_errors_the_whole_machine_closes_on_equations_4_and_7():
    """All five limbs of the nominal machine, S joints level with A_j: what tells where h_s belongs."""
    machine = Overconstrained2Dof()
    poses = _poses(machine)
    position, rotation = machine.as_built(machine.solve_inverse(poses))
    nominal = machine.frame(poses)
    torch.testing.assert_close(position, nominal[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(rotation, nominal[1], rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="do not close"):
        Overconstrained2Dof(origin="joint").as_built(torch.zeros(2, dtype=torch.float64))


def _assembled(q, start):
    """The machine of Table 2 by scipy, all six passive and active cranks among the unknowns: r', R, β3, β4."""

    def residual(x):
        position, rotation = x[:3], Rotation.from_rotvec(x[3:6]).as_matrix()
        cranks = [q[0] + ERRORS[0, -1], q[1] + ERRORS[1, -1], x[6], x[7]]
        gaps, aside = [], []
        for limb, beta in enumerate(cranks):
            error = ERRORS[limb] if limb < 2 else np.zeros(11)
            link = _platform_joint(position, rotation, limb, error) - _crank_end(beta, limb, error)
            gaps.append(np.linalg.norm(link) - (L + error[6]))
            aside.append(link @ rotation @ Rotation.from_euler("z", limb * math.pi / 2).apply([0.0, 1.0, 0.0]))
        held = np.linalg.norm(position - H_S * rotation[:, 2]) - H
        return np.array([*gaps, aside[0], aside[1], aside[2] + aside[3], held])

    return least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)


def test_machine_as_built_against_scipy():
    machine, values = _machine_of_table_2()
    poses = _poses(machine, 6)
    joints = machine.solve_inverse(poses)
    position, rotation = machine.as_built(joints, values)
    nominal = Overconstrained2Dof().frame(poses)
    for i, q in enumerate(joints.tolist()):
        turned = Rotation.from_matrix(nominal[1][i].numpy()).as_rotvec()
        passive = []
        for limb in (2, 3):
            frame = Rotation.from_euler("z", -limb * math.pi / 2).as_matrix()
            a, b, c = _appendix(frame @ nominal[0][i].numpy(), frame @ nominal[1][i].numpy() @ frame.T, 0, np.zeros(11))
            passive.append(2 * math.atan((-b + math.sqrt(b**2 - c**2 + a**2)) / (c - a)))
        theirs = _assembled(q, np.concatenate([nominal[0][i].numpy(), turned, passive]))
        assert np.abs(theirs.fun).max() < 1e-11
        np.testing.assert_allclose(position[i].numpy(), theirs.x[:3], atol=1e-9)
        np.testing.assert_allclose(rotation[i].numpy(), Rotation.from_rotvec(theirs.x[3:6]).as_matrix(), atol=1e-9)
    # Its limbs 1 and 2 obey eq. 13 exactly, and it turns about w, which eq. 4 knows nothing of.
    torch.testing.assert_close(machine.joints_of_frame(position, rotation, values), joints, rtol=0, atol=1e-12)
    torsion = torch.atan2(rotation[:, 1, 0] - rotation[:, 0, 1], rotation[:, 0, 0] + rotation[:, 1, 1])
    assert float(torsion.abs().max()) > 1e-3


def test_a_measured_machine_does_not_show_where_a_joint_sits_along_its_axis():
    """The upper link of a machine as built is square to its R joint, so that ⁶δy changes no length to first order.

    On poses of eqs. 4 and 7 as they stand, which such a machine does not reach, it would.
    """
    machine, values = _machine_of_table_2()
    poses = _poses(machine, 60)
    joints = machine.solve_inverse(poses)
    names = [g.name for g in machine.geometry]
    for frame, seen in ((machine.as_built(joints, values), False), (machine.frame(poses), True)):
        slope = jacobian_of(lambda v, f=frame: machine.joints_of_frame(*f, v), values.expand(60, -1))[1]
        for leg in (1, 2):
            column = slope[:, leg - 1, names.index(f"dAy{leg}")].abs().max()
            assert (float(column) > 1e-3) == seen
            assert seen or float(column) < 1e-9


def test_keys():
    machine = load_mechanism("overconstrained_2dof", origin="joint")
    assert machine.describe()["keys"] == {"origin": "joint"}
    assert [g.leg for g in machine.geometry] == [None] * 4 + [1] * 11 + [2] * 11
    with pytest.raises(InputError, match="origin is 'surface' or 'joint'"):
        load_mechanism("overconstrained_2dof", origin="top")
