"""The regularised linear step and the corner of its L-curve."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from linkages import NOISE, measured

from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice, inverse_problem, l_curve, solve_lm, solve_tikhonov
from ccnn_torch.identification.problems.problem import WeightedRows
from ccnn_torch.mechanisms import load_mechanism


def test_every_point_of_the_curve_solves_its_ridge_problem() -> None:
    rows = measured(2, 24, 1)
    problem = inverse_problem(
        rows.mechanism, rows.joints, rows.pose, choice=ParameterChoice(prior={"l?": 1e-2}), pose_noise=NOISE
    )
    curve = l_curve(problem, problem.start)
    point = problem.start[:, None].expand(2, 24, -1)
    residual = problem.residual(point, *problem.data)[1].flatten().numpy()
    slope = WeightedRows(problem).jacobian(problem.start[:, None], torch.arange(2))[1][1, 0].numpy()
    prior = np.diag((problem.scale / problem.prior_sd).numpy())
    matrix, right = np.vstack([slope, prior]), np.append(-residual, np.zeros(12))
    for i in (0, 60, int(curve.corner[1]), 120):
        ridge = float(curve.weight[1, i]) * np.eye(12)
        step = np.linalg.lstsq(np.vstack([matrix, ridge]), np.append(right, np.zeros(12)), rcond=None)[0]
        assert float(curve.size[1, i]) == pytest.approx(np.linalg.norm(step), rel=1e-6)
        assert float(curve.misfit[1, i]) == pytest.approx(np.linalg.norm(matrix @ step - right), rel=1e-6)
        if i == int(curve.corner[1]):
            np.testing.assert_allclose(curve.step[1], step, rtol=1e-6)


def test_the_corner_is_where_the_curve_bends_most() -> None:
    """Against finite differences along the curve."""
    rows = measured(6, 36, 2)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    curve = l_curve(problem, problem.start)
    for machine in range(6):
        t, x, y = (np.log(v[machine].numpy()) for v in (curve.weight, curve.misfit, curve.size))
        x1, y1 = np.gradient(x, t), np.gradient(y, t)
        bend = (x1 * np.gradient(y1, t) - np.gradient(x1, t) * y1) / (x1**2 + y1**2) ** 1.5
        # Beyond the smallest singular value both ends of the curve stand still and differences are rounding.
        firm = slice(5, 90)
        assert abs(int(np.argmax(bend[firm])) + 5 - int(curve.corner[machine])) <= 2


def test_it_goes_most_of_the_way_but_is_biased() -> None:
    rows = measured(20, 36, 3, error=0.3)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    shares: list[float] = []
    fit = solve_tikhonov(problem, progress=shares.append)
    assert shares == [1.0] and bool(fit.converged.all())
    before = WeightedRows(problem).cost(problem.start[:, None], torch.arange(20))[:, 0]
    assert bool((fit.cost < 0.05 * before).all())
    assert bool((fit.cost > solve_lm(problem).cost).all())
    torch.testing.assert_close(fit.cost, WeightedRows(problem).cost(fit.values[:, None], torch.arange(20))[:, 0])


def test_a_step_out_of_reach_is_not_taken() -> None:
    """Joints so far off that the linear step makes the legs too short for the poses."""
    tripod = load_mechanism("tripod")
    joints = tripod.sample_joints(12, torch.Generator().manual_seed(0))
    shifted = torch.stack([joints + 1e-3, joints - 0.8])
    problem = inverse_problem(tripod, shifted, tripod.forward_kinematics(joints), pose_noise=NOISE)
    fit = solve_tikhonov(problem)
    assert fit.converged.tolist() == [True, False]
    assert torch.equal(fit.values[1], problem.start[1]) and not torch.equal(fit.values[0], problem.start[0])
    assert fit.message == "1 of 2 machines: the step leads out of reach; the first is number 2"
    with pytest.raises(InputError, match="machine 1: the residual is not finite where it is linearised"):
        l_curve(problem, 0.1 * problem.start)
