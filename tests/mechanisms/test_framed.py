"""A mechanism seen from a measuring device: frames on both sides, against scipy's transforms."""

import json

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import (
    FiveBar,
    Framed,
    SerialArm,
    Stewart,
    as_measured,
    load_mechanism,
    mechanism_from_description,
)
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.records import load_records, read_table, write_table
from ccnn_torch.records.headers import read_pose

BASE = [0.3, -0.2, 0.5, 0.4, -0.3, 1.0]
TOOL = [0.02, 0.01, 0.03, 0.1, 0.2, -0.1]


def _framed(mechanism, base=True, tool=True):
    framed = Framed(mechanism, base, tool)
    values = framed.nominal.clone()
    if base:
        values[:6] = torch.tensor(BASE, dtype=torch.float64)
    if tool:
        values[-6:] = torch.tensor(TOOL, dtype=torch.float64)
    return framed.with_nominal(values)


def _transform(vector):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(vector[3:]).as_matrix(), vector[:3]
    return matrix


def _matrices(frame):
    matrices = np.tile(np.eye(4), (len(frame[0]), 1, 1))
    matrices[:, :3, 3], matrices[:, :3, :3] = frame[0].numpy(), frame[1].numpy()
    return matrices


def test_a_machine_that_moves_in_a_plane_needs_no_z(tmp_path):
    framed = _framed(FiveBar(), tool=False)
    joints = framed.sample_joints(20, torch.Generator().manual_seed(0)).T.numpy()
    table = dict(zip(("q1[rad]", "q2[rad]", "x[mm]", "y[mm]"), (*joints, joints[0], joints[1]), strict=True))
    write_table(tmp_path / "flat.csv", table)
    write_table(tmp_path / "zeros.csv", table | {"z[mm]": np.zeros(20)})
    flat, zeros = (load_records(tmp_path / f"{name}.csv", framed) for name in ("flat", "zeros"))
    assert torch.equal(flat.pose, zeros.pose) and flat.pose_coordinates == zeros.pose_coordinates == framed.pose
    assert as_measured(framed, flat.pose_coordinates) is framed
    assert np.array_equal(read_pose(read_table(tmp_path / "flat.csv"), framed)[0], zeros.pose.numpy())


@pytest.mark.parametrize("name", ["stewart", "overconstrained_2dof", "tripod", "machine_tool"])
def test_pose_is_base_times_mechanism_times_tool(name):
    mechanism = load_mechanism(name)
    framed = _framed(mechanism)
    joints = mechanism.sample_joints(8, torch.Generator().manual_seed(0))
    seen = framed.forward_kinematics(joints)
    inside = _matrices(mechanism.frame(mechanism.forward_kinematics(joints)))
    np.testing.assert_allclose(
        _matrices(framed.frame(seen)), _transform(BASE) @ inside @ _transform(TOOL), rtol=0, atol=1e-12
    )
    back = framed.solve_inverse(seen)
    torch.testing.assert_close(framed.wrap(back - joints), torch.zeros_like(joints), rtol=0, atol=1e-9)
    assert framed.reachable(seen).all() and float(framed.closure(seen, joints).abs().max()) < 1e-12


def test_a_planar_mechanism_in_space():
    framed = _framed(FiveBar(), tool=False)
    joints = framed.mechanism.sample_joints(20, torch.Generator().manual_seed(1))
    seen = framed.forward_kinematics(joints)
    assert [c.name for c in framed.pose] == ["x", "y", "z"]
    # All points lie in the plane of the base frame.
    normal = torch.from_numpy(_transform(BASE)[:3, 2])
    torch.testing.assert_close((seen - torch.tensor(BASE[:3]).double()) @ normal, torch.zeros(20).double())
    # A point beside the plane has the joints of its foot.
    torch.testing.assert_close(framed.solve_inverse(seen + 0.01 * normal), joints, rtol=0, atol=1e-12)


def test_closest_pose_is_the_least_squares_one():
    """A frame that the mechanism cannot take, against scipy's search over its two pose coordinates."""
    framed = _framed(load_mechanism("overconstrained_2dof"), tool=False)
    seen = framed.sample_workspace(2, torch.Generator().manual_seed(2))
    off = seen + 0.01 * torch.randn(2, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    ours = framed.solve_inverse(off)
    for q, pose, start in zip(ours, off, framed.solve_inverse(seen), strict=True):

        def gap(q, pose=pose):
            there = framed.closure(pose, torch.from_numpy(q))
            return torch.cat([there[:3], 0.04 * there[3:]]).numpy()

        theirs = least_squares(gap, start.numpy(), xtol=1e-10)
        np.testing.assert_allclose(q.numpy(), theirs.x, atol=1e-6)


def test_box_and_home_follow_the_frames():
    framed = _framed(Stewart())
    poses = framed.sample_workspace(500, torch.Generator().manual_seed(4))
    inside = ((poses >= framed.low) & (poses <= framed.high)).double().mean(0)
    assert float(inside.min()) > 0.97
    torch.testing.assert_close(framed.forward_kinematics(framed.home_joints), framed.home_pose)


def test_base_and_tool_of_a_six_axis_platform_are_not_known_apart():
    """36 joints' coordinates make up for any base and tool: an identification must see the null directions."""
    framed = _framed(Stewart())
    poses = framed.sample_workspace(80, torch.Generator().manual_seed(5))
    slope = jacobian_of(lambda v: framed.solve_inverse(poses, v), framed.nominal.expand(80, -1))[1]
    values = torch.linalg.svdvals(slope.flatten(0, 1))
    assert int((values < 1e-10 * values[0]).sum()) == 12


def test_legs_keep_their_numbers_and_descriptions_their_mechanism():
    framed = Framed(FiveBar(l=0.4, L=0.6, a=0.3))
    assert [g.leg for g in framed.geometry] == [None] * 6 + [1] * 6 + [2] * 6
    twin = mechanism_from_description(json.loads(json.dumps(framed.describe())))
    assert torch.equal(twin.nominal, framed.nominal) and twin.mechanism.name == "five_bar"
    again = load_mechanism("framed", mechanism="five_bar", base=True)
    assert again.name == "framed_five_bar" and torch.equal(again.mechanism.nominal, FiveBar().nominal)


def test_refusals():
    with pytest.raises(InputError, match="'delta' has no orientation"):
        load_mechanism("framed", mechanism="delta", tool=True)
    arm = SerialArm("arm", "standard", [[0.0, 1.0, 0.2, 0.0], [0.3, 0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=r"called as the frames of .framed. are: base_rx"):
        Framed(arm)
