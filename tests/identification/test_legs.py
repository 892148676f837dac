"""Divide and conquer: each leg by itself gives what all legs together give, where nothing ties them."""

from __future__ import annotations

import pytest
import torch
from linkages import NOISE, measured

from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    ParameterChoice,
    forward_problem,
    inverse_problem,
    solve_lm,
    split_by_leg,
)
from ccnn_torch.mechanisms import load_mechanism


@pytest.mark.parametrize("name", ["five_bar", "stewart", "delta_linear"])
def test_legs_apart_are_legs_together(name: str) -> None:
    rows = measured(3, 40, 1, name=name)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE, per_leg=True)
    parts, together = split_by_leg(problem), solve_lm(problem)
    apart = [solve_lm(part) for part in parts]
    torch.testing.assert_close(sum(fit.cost for fit in apart), together.cost, rtol=1e-7, atol=0)
    names = [p.name for part in parts for p in part.parameters]
    order = [names.index(p.name) for p in problem.parameters]
    values = torch.cat([fit.values for fit in apart], dim=-1)[:, order]
    torch.testing.assert_close(values, together.values, rtol=0, atol=1e-5)
    assert all(bool(fit.converged.all()) for fit in apart)


def test_a_leg_has_its_own_parameters_channels() -> None:
    rows = measured(1, 20, 2)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE, per_leg=True)
    first, second = split_by_leg(problem)
    assert [p.name for p in second.parameters] == ["l2", "L2", "A2x", "A2y", "k2", "gamma2"]
    assert [(c.name, c.leg) for c in first.channels + second.channels] == [("q1", 1), ("q2", 2)]
    point = problem.start[:, None].expand(1, 20, -1)
    whole = problem.residual(point, *problem.data)
    torch.testing.assert_close(first.residual(point[..., :6], *first.data), whole[..., :1], rtol=0, atol=0)
    torch.testing.assert_close(second.residual(point[..., 6:], *second.data), whole[..., 1:], rtol=0, atol=0)


def test_one_leg_alone_leaves_the_other_joint_out() -> None:
    """Its pose set may be planned for it: the other leg's errors then do not count as noise."""
    rows = measured(2, 30, 3)
    choice = ParameterChoice(free=["leg2.*"])
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, choice=choice, pose_noise=NOISE, per_leg=True)
    assert [c.name for c in problem.channels] == ["q2"]
    everything = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE, per_leg=True)
    torch.testing.assert_close(solve_lm(problem).values, solve_lm(everything).values[:, 6:], rtol=0, atol=1e-5)


def test_what_ties_the_legs_is_named() -> None:
    rows = measured(1, 20, 4)
    full = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    with pytest.raises(InputError, match="channel 'q2' depends on the parameters of legs 1, 2"):
        split_by_leg(full)
    forward = forward_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    with pytest.raises(InputError, match="channel 'x' depends on the parameters of legs 1, 2"):
        split_by_leg(forward)
    tied = inverse_problem(
        rows.mechanism, rows.joints, rows.pose, choice=ParameterChoice(tied=["l?"]), pose_noise=NOISE, per_leg=True
    )
    with pytest.raises(InputError, match="parameter 'l1' belongs to no single leg"):
        split_by_leg(tied)
    tripod = load_mechanism("tripod")
    joints = tripod.sample_joints(9, torch.Generator().manual_seed(0))
    common = inverse_problem(tripod, joints, tripod.forward_kinematics(joints), per_leg=True)
    with pytest.raises(InputError, match="parameter 'L' belongs to no single leg"):
        split_by_leg(common)


def test_a_leg_with_too_few_rows_is_refused() -> None:
    rows = measured(1, 4, 5)
    choice = ParameterChoice(fixed=["leg2.l2", "leg2.L2", "leg2.A*", "k2"])
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, choice=choice, per_leg=True)
    with pytest.raises(InputError, match="4 rows of 1 equation cannot determine 6 free parameters; measure at least 6"):
        split_by_leg(problem)
