"""Serial arms against plain numpy loops, scipy's rotations and scipy's optimizers."""

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import torch
from catalogue import PANDA, SCARA, UR10, URDF, make
from ruamel.yaml import YAML
from scipy.linalg import null_space
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm


def _rot(axis, angle):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.asarray(axis, float) * angle).as_matrix()
    return matrix


def _trans(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def _naive_dh(text, joints):
    """Product of the elementary transforms that the convention names, one joint after the other."""
    table = YAML(typ="safe").load(text)
    length = {"m": 1.0, "mm": 1e-3}[table["units"]["length"]]
    angle = {"rad": 1.0, "deg": math.pi / 180}[table["units"]["angle"]]
    x, z = (1, 0, 0), (0, 0, 1)
    placed = np.eye(4)
    for i, q in enumerate(joints):
        a, alpha, d, theta = (
            table[k][i] * u for k, u in zip(("a", "alpha", "d", "theta"), (length, angle) * 2, strict=True)
        )
        q = q * table.get("joint_sign", [1] * len(joints))[i]
        if table.get("joint_types", ["revolute"] * len(joints))[i] == "revolute":
            theta += q
        else:
            d += q
        joint, link = _rot(z, theta) @ _trans(0, 0, d), [_trans(a, 0, 0), _rot(x, alpha)]
        if table["convention"].startswith("standard"):
            placed = placed @ joint @ link[0] @ link[1]
        else:
            placed = placed @ link[1] @ link[0] @ joint
    tool = table.get("tool_frame", "unknown")
    if isinstance(tool, list):
        turn = np.asarray(tool[3:]) * angle
        placed = placed @ _trans(*(v * length for v in tool[:3])) @ _rot(turn, 1.0)
    return placed


def _naive_urdf(joints):
    placed, i = np.eye(4), 0
    for joint in ElementTree.fromstring(URDF).findall("joint"):
        origin = joint.find("origin")
        step = _trans(*map(float, origin.get("xyz").split()))
        step[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in origin.get("rpy", "0 0 0").split()]).as_matrix()
        placed = placed @ step
        if joint.get("type") == "fixed":
            continue
        axis = np.array([float(v) for v in joint.find("axis").get("xyz").split()])
        axis = axis / np.linalg.norm(axis)
        prismatic = joint.get("type") == "prismatic"
        placed = placed @ (_trans(*(axis * joints[i])) if prismatic else _rot(axis, joints[i]))
        i += 1
    return placed


@pytest.mark.parametrize("name", ["ur10", "panda", "scara", "urdf"])
def test_forward_kinematics_is_the_product_of_the_joints(name, tmp_path):
    arm = make(name, tmp_path)
    joints = arm.sample_joints(12, torch.Generator().manual_seed(1))
    position, rotation = arm.forward_frame(joints)
    text = {"ur10": UR10, "panda": PANDA, "scara": SCARA}.get(name)
    for q, p, r in zip(joints.numpy(), position.numpy(), rotation.numpy(), strict=True):
        expected = _naive_urdf(q) if text is None else _naive_dh(text, q)
        np.testing.assert_allclose(p, expected[:3, 3], atol=1e-14)
        np.testing.assert_allclose(r, expected[:3, :3], atol=1e-14)


def test_base_and_tool_frames_stand_around_the_chain(tmp_path):
    arm = make("ur10", tmp_path)
    joints = arm.sample_joints(1, torch.Generator().manual_seed(1))
    values = arm.nominal.clone()
    values[:6] = torch.tensor([1.0, 2.0, 3.0, 0.3, -0.4, 2.0])
    values[-6:] = torch.tensor([0.1, 0.2, 0.3, -1.0, 0.5, 0.7])
    position, rotation = arm.forward_frame(joints, values)
    base, tool = (_trans(*f[:3]) @ _rot(f[3:], 1.0) for f in (values[:6].numpy(), values[-6:].numpy()))
    expected = base @ _naive_dh(UR10, joints[0].numpy()) @ tool
    np.testing.assert_allclose(position[0].numpy(), expected[:3, 3], atol=1e-14)
    np.testing.assert_allclose(rotation[0].numpy(), expected[:3, :3], atol=1e-14)


def test_a_dh_arm_as_urdf_is_the_same_arm(tmp_path):
    """Standard DH written as URDF origins (the link's fixed part moves into the next joint's origin)."""
    arm = make("ur10", tmp_path)
    rows = arm.nominal[6:-6].reshape(6, 4)
    lines = ['<robot name="twin"><link name="l0"/>']
    a, alpha = 0.0, 0.0
    for i, (next_a, next_alpha, d, theta) in enumerate(rows.tolist()):
        # Tx(a) Rx(alpha) of the link before, then Tz(d): rpy turns about x, d is along the turned z.
        xyz = f"{a!r} {-math.sin(alpha) * d!r} {math.cos(alpha) * d!r}"
        lines.append(
            f'<link name="l{i + 1}"/><joint name="j{i + 1}" type="continuous"><parent link="l{i}"/>'
            f'<child link="l{i + 1}"/><origin xyz="{xyz}" rpy="{alpha!r} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
        assert theta == 0.0
        a, alpha = next_a, next_alpha
    path = tmp_path / "twin.urdf"
    path.write_text("".join(lines) + "</robot>")
    from ccnn_torch.mechanisms import load_mechanism

    twin = load_mechanism(str(path))
    joints = arm.sample_joints(20, torch.Generator().manual_seed(2))
    for got, expected in zip(twin.forward_frame(joints), arm.forward_frame(joints), strict=True):
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-14)


def _away(arm, count, size, seed=0):
    """Poses that the joints nearly reach, and these joints: as measured rows are."""
    generator = torch.Generator().manual_seed(seed)
    joints = arm.sample_joints(200, generator)
    joints = joints[arm.condition_number(joints) < 60][:count]
    moved = joints + size * torch.randn(joints.shape, generator=generator, dtype=torch.float64)
    return joints, arm.forward_kinematics(moved)


@pytest.mark.parametrize("name", ["panda", "ur10_positions"])
def test_redundant_joints_take_the_shortest_way(name, tmp_path):
    """The pose is met, and no step along the arm's self-motion would make the deviation smaller."""
    arm = make(name, tmp_path)
    commanded, pose = _away(arm, 20, 5e-3)
    found = arm.solve_inverse(pose, guess=commanded)
    assert float(arm.closure(pose, found).abs().max()) < 1e-12
    for slope, delta in zip(arm.jacobian(found).numpy(), (found - commanded).numpy(), strict=True):
        np.testing.assert_allclose(null_space(slope).T @ delta, 0, atol=1e-10)


def test_shortest_way_against_a_constrained_optimizer(tmp_path):
    arm = make("ur10_positions", tmp_path)
    commanded, pose = _away(arm, 3, 5e-3)
    ours = (arm.solve_inverse(pose, guess=commanded) - commanded).numpy()
    for i in range(len(pose)):

        def gap(delta, i=i):
            return arm.closure(pose[i], commanded[i] + torch.from_numpy(delta)).numpy()

        def slope(delta, i=i):
            return arm.jacobian(commanded[i] + torch.from_numpy(delta)).numpy()

        theirs = minimize(
            lambda d: 1e4 * d @ d,
            np.zeros(len(ours[i])),
            jac=lambda d: 2e4 * d,
            constraints={"type": "eq", "fun": gap, "jac": slope},
            method="SLSQP",
            options={"ftol": 1e-16, "maxiter": 300},
        )
        np.testing.assert_allclose(gap(ours[i]), 0, atol=1e-12)
        assert np.linalg.norm(ours[i]) <= np.linalg.norm(theirs.x) * (1 + 1e-6)
        np.testing.assert_allclose(ours[i], theirs.x, atol=2e-6)


def test_what_the_joints_cannot_reach_is_the_least_squares_minimum(tmp_path):
    """A four-joint arm and full poses: the closest pose in (position, 0.04 m x rotation vector), as scipy finds it."""
    arm = make("scara", tmp_path)
    commanded, pose = _away(arm, 3, 5e-3)
    pose = pose + 1e-3 * torch.randn(pose.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    weights = np.array([1.0] * 3 + [0.04] * 3)
    ours = arm.nearest_joints(pose, None, commanded, 0.04)
    for q, x, start in zip(ours.numpy(), pose, commanded.numpy(), strict=True):
        theirs = least_squares(
            lambda v, x=x: arm.closure(x, torch.from_numpy(v)).numpy() * weights,
            start,
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        np.testing.assert_allclose(q, theirs.x, atol=1e-7)


def test_damping_is_ridge_regression(tmp_path):
    arm = make("ur10", tmp_path)
    commanded, pose = _away(arm, 3, 1e-4)
    weights = torch.tensor([1.0] * 3 + [0.04] * 3, dtype=torch.float64)
    ours = arm.nearest_joints(pose, None, commanded, 0.04, damping=0.05) - commanded
    rows = arm.jacobian(commanded) * weights[:, None]
    gap = arm.closure(pose, commanded) * weights
    ridge = rows.mT @ rows + 0.05**2 * torch.eye(6, dtype=torch.float64)
    linear = -torch.linalg.solve(ridge, rows.mT @ gap[..., None])[..., 0]
    torch.testing.assert_close(ours, linear, rtol=0, atol=5e-7)
    assert (ours.norm(dim=-1) < (arm.nearest_joints(pose, None, commanded, 0.04) - commanded).norm(dim=-1)).all()


def test_reach_bounds_every_pose(tmp_path):
    for name in ("ur10", "panda", "scara", "urdf"):
        arm = make(name, tmp_path)
        pose = arm.sample_workspace(500, torch.Generator().manual_seed(0))
        farthest = float((pose[:, :3] - arm.nominal[:3]).norm(dim=-1).max())
        assert 0.5 * arm.reach < farthest <= arm.reach
        far = pose[:1].clone()
        far[0, 0] += 3 * arm.reach
        assert arm.reachable(pose).all() and not arm.reachable(far).any()


def test_parameter_names_and_frames(tmp_path):
    arm = make("ur10", tmp_path)
    names = [g.name for g in arm.geometry]
    assert names[:6] == ["base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz"]
    assert names[6:10] == ["a1", "alpha1", "d1", "theta1"] and names[-1] == "tool_rz" and len(names) == 12 + 24
    assert arm.unknown_frames == ("base", "tool") and arm.parallel_axes == ((2, 3, 4),)
    assert [c.name for c in arm.with_orientation("none").pose] == ["x", "y", "z"]
    panda = make("panda", tmp_path)
    assert panda.unknown_frames == () and panda.nominal[-1] == pytest.approx(math.pi / 4)
    assert isinstance(panda, SerialArm)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"masses": [1.0]}, "masses are 2 numbers"),
        ({"masses": [1.0, math.nan]}, "masses are 2 numbers"),
        ({"masses": [1.0, math.inf]}, "masses are 2 numbers"),
        ({"masses": [1.0, 1.0], "centres": [[], [1.0]]}, "centres are 2 times x, y, z"),
        ({"masses": [1.0, 1.0], "centres": [[]]}, "centres are 2 times x, y, z"),
    ],
)
def test_masses_that_are_none_are_refused(keys, said):
    with pytest.raises(InputError, match=said):
        SerialArm("arm", "standard", [[0.4, 0, 0, 0], [0.2, 0, 0, 0]], **keys)
