"""The inverse-calibration residual: its noise, its Jacobian, its parameters, and what it refuses."""

from __future__ import annotations

import math

import pytest
import torch
from linkages import NOISE, measured
from mechanisms.five_bar import FiveBar as ClosureAlone

from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice, inverse_problem, solve_lm
from ccnn_torch.identification.problems.problem import row_jacobian
from ccnn_torch.mechanisms import load_mechanism


@pytest.mark.parametrize("name", ["five_bar", "machine_tool"])
def test_at_the_truth_the_residual_is_white(name: str) -> None:
    """Over many redrawn poses the residual has unit covariance between its channels, joint noise included."""
    rows = measured(1, 4000, 1, error=0.1, noise=0, name=name)
    generator = torch.Generator().manual_seed(2)
    sd = torch.linspace(1e-4, 3e-4, rows.pose.shape[-1], dtype=torch.float64)
    pose = rows.clean + sd * torch.randn(rows.clean.shape, generator=generator, dtype=torch.float64)
    joints = rows.joints + 2e-4 * torch.randn(rows.joints.shape, generator=generator, dtype=torch.float64)
    problem = inverse_problem(rows.mechanism, joints, pose, pose_noise=sd, joint_noise=2e-4)
    residual = problem.residual(rows.truth[:, None].expand(1, 4000, -1), *problem.data)[0]
    spread = torch.cov(residual.mT)
    # Five standard errors of an entry of the covariance of 4,000 rows.
    torch.testing.assert_close(spread, torch.eye(len(spread), dtype=torch.float64), rtol=0, atol=5 * (2 / 4000) ** 0.5)


def test_without_decorrelation_every_joint_has_unit_variance() -> None:
    rows = measured(1, 4000, 1, error=0.1)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE, per_leg=True)
    residual = problem.residual(rows.truth[:, None].expand(1, 4000, -1), *problem.data)[0]
    assert bool(((residual.std(0) - 1).abs() < 0.06).all())
    assert [c.leg for c in problem.channels] == [1, 2]


@pytest.mark.parametrize("name", ["five_bar", "stewart", "delta", "machine_tool", "tripod"])
@pytest.mark.parametrize("per_leg", [False, True])
def test_the_quick_jacobian_is_that_of_the_residual(name: str, per_leg: bool) -> None:
    rows = measured(2, 24, 3, name=name)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE, per_leg=per_leg)
    point = rows.truth[:, None].expand(2, 24, -1)
    value, slope = problem.residual.jacobian(point, problem.data)
    torch.testing.assert_close(value, problem.residual(point, *problem.data), rtol=1e-12, atol=1e-12)
    step = 1e-3 * problem.scale
    for i in range(len(step)):
        ahead, behind = point.clone(), point.clone()
        ahead[..., i] += step[i]
        behind[..., i] -= step[i]
        difference = problem.residual(ahead, *problem.data) - problem.residual(behind, *problem.data)
        torch.testing.assert_close(slope[..., i] * step[i] * 2, difference, rtol=1e-5, atol=1e-6)


def test_large_batches_take_the_same_jacobian_as_small_ones() -> None:
    values = torch.linspace(-1, 1, 3000 * 4, dtype=torch.float64).reshape(3000, 4)

    def function(x: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
        return torch.stack([torch.sin(x).prod(-1) * row[..., 0], x.square().sum(-1)], dim=-1)

    row = torch.linspace(1, 2, 3000, dtype=torch.float64)[:, None]
    whole = row_jacobian(function, values, (row,), 2)
    parts = [row_jacobian(function, v, (d,), 2) for v, d in zip(values.split(500), row.split(500), strict=True)]
    for i in range(2):
        torch.testing.assert_close(whole[i], torch.cat([p[i] for p in parts]), rtol=1e-14, atol=1e-14)


def test_commands_beyond_a_turn_are_the_same_angle() -> None:
    rows = measured(1, 20, 4)
    plain = inverse_problem(rows.mechanism, rows.joints, rows.pose)
    turned = inverse_problem(rows.mechanism, rows.joints + 2 * math.pi, rows.pose)
    for problem in (plain, turned):
        assert float(problem.residual(problem.start[:, None].expand(1, 20, -1), *problem.data).abs().max()) < 0.1


def test_fixed_parameters_may_differ_between_machines() -> None:
    rows = measured(3, 30, 5, noise=0)
    choice = ParameterChoice(free=["leg1.*"])
    start = rows.mechanism.nominal.repeat(3, 1)
    start[:, 6:] = rows.truth[:, 6:]
    fit = solve_lm(inverse_problem(rows.mechanism, rows.joints, rows.clean, choice=choice, start=start))
    torch.testing.assert_close(fit.values, rows.truth[:, :6], rtol=0, atol=1e-9)


def test_a_mechanism_of_its_closure_alone_is_identified() -> None:
    mechanism = ClosureAlone()
    truth = mechanism.nominal + torch.tensor([1e-3, -2e-3, 1.5e-3], dtype=torch.float64)
    joints = mechanism.sample_joints(15, torch.Generator().manual_seed(0))
    fit = solve_lm(inverse_problem(mechanism, joints, mechanism.forward_kinematics(joints, truth)))
    torch.testing.assert_close(fit.values[0], truth, rtol=0, atol=1e-9)


def test_left_out_rows_are_not_looked_at() -> None:
    rows = measured(2, 30, 6)
    weights = torch.ones(2, 30, dtype=torch.float64)
    weights[0, 20:] = 0
    weights[1, :10] = 0
    spoilt = rows.pose.clone()
    spoilt[0, 20:] = 99.0
    spoilt[1, :10] = math.nan
    fit = solve_lm(inverse_problem(rows.mechanism, rows.joints, spoilt, weights, pose_noise=NOISE))
    for machine, kept in ((0, slice(0, 20)), (1, slice(10, 30))):
        alone = inverse_problem(rows.mechanism, rows.joints[machine, kept], rows.pose[machine, kept], pose_noise=NOISE)
        torch.testing.assert_close(fit.values[machine], solve_lm(alone).values[0], rtol=0, atol=1e-6)


TRIPOD = load_mechanism("tripod")
JOINTS = TRIPOD.sample_joints(6, torch.Generator().manual_seed(0))
POSE = TRIPOD.forward_kinematics(JOINTS)


def far(row: int) -> torch.Tensor:
    pose = POSE.clone()
    pose[row, 1] = 5.0
    return pose


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"pose": far(3)}, "row 4: tripod with its starting geometry is out of reach at y = "),
        ({"pose": far(3)}, "joint q1 has no solution (1 row so in all)"),
        ({"pose": POSE[:, :2]}, "needs a column for each of y, z, phi"),
        ({"pose": POSE[:4]}, "do not fit together"),
        ({"joints": JOINTS.log() * math.nan}, "row 1: q1 is not a finite number"),
        ({"weights": torch.tensor([1.0, -1, 1, 1, 1, 1])}, "weights must be 0 or positive"),
        ({"weights": torch.zeros(6)}, "machine 1 of 1: no row has a weight above 0"),
        ({"pose_noise": [1e-4, 1e-4]}, "pose_noise: give one standard deviation, or one for each of y, z, phi"),
        ({"pose_noise": -1.0}, "none negative"),
        ({"pose_noise": [0.0, 1e-4, 1e-4]}, "row 1: the noise given leaves a direction of the residual without any"),
        ({"choice": ParameterChoice(prior={"L": 1e-3})}, "only if their noise is given"),
    ],
)
def test_bad_rows_are_named(keys: dict[str, object], said: str) -> None:
    given = {"joints": JOINTS, "pose": POSE} | keys
    with pytest.raises(InputError) as refusal:
        inverse_problem(TRIPOD, **given)  # type: ignore[arg-type]
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_fewer_equations_than_parameters_are_refused() -> None:
    rows = measured(1, 5, 7)
    with pytest.raises(InputError, match=r"5 rows of 2 equations cannot determine 12 .* measure at least 6 rows"):
        inverse_problem(rows.mechanism, rows.joints, rows.pose)
