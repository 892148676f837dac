"""Standard errors, coverage, and what cannot be known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from linkages import NOISE, measured

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    Channel,
    ParameterChoice,
    Problem,
    inverse_problem,
    solve_lm,
    what_is_known,
)


@pytest.mark.parametrize("kind", ["known noise", "unknown noise", "per leg"])
def test_intervals_hold_the_truth_as_often_as_they_say(kind: str) -> None:
    """1,000 machines in one batch: a parameter's share has a standard error of 0.7 %, all together of about 0.3 %."""
    rows = measured(1000, 36, 1)
    per_leg = kind != "known noise"
    noise = None if kind == "unknown noise" else NOISE
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=noise, per_leg=per_leg)
    fit = solve_lm(problem)
    assert bool(fit.converged.all())
    known = what_is_known(problem, fit.values)
    held = ((fit.values - rows.truth).abs() <= 1.96 * known.sd).to(torch.float64).mean(0)
    assert 0.93 < float(held.mean()) < 0.97
    assert float(held.min()) > 0.91
    if noise is not None:
        assert abs(float(known.noise.mean()) - 1) < 0.02
        # Errors are as large as the Cramér-Rao bound says.
        ratio = ((fit.values - rows.truth) / what_is_known(problem, rows.truth).sd).square().mean(0).sqrt()
        assert float((ratio - 1).abs().max()) < 0.1


def linear(matrix: np.ndarray, noise: float = 1.0, known: bool = True) -> Problem:
    """Residual (A values - y) / noise."""
    rows, k = matrix.shape
    generator = torch.Generator().manual_seed(0)
    y = noise * torch.randn(rows, 1, generator=generator, dtype=torch.float64)
    data = torch.cat([torch.from_numpy(matrix), y], dim=-1)
    return Problem(
        parameters=tuple(Parameter(f"p{i + 1}", "m", 0.0) for i in range(k)),
        start=torch.zeros(1, k, dtype=torch.float64),
        scale=torch.full((k,), 1e-3, dtype=torch.float64),
        prior_sd=torch.full((k,), torch.inf, dtype=torch.float64),
        residual=lambda v, d: ((v * d[..., :-1]).sum(-1, keepdim=True) - d[..., -1:]) / noise,
        data=(data[None],),
        weights=torch.ones(1, rows, dtype=torch.float64),
        channels=(Channel("y"),),
        noise_known=known,
    )


def test_a_linear_problem_has_the_textbook_covariance() -> None:
    matrix = np.random.default_rng(1).standard_normal((20, 4)) * 1e4
    for known in (True, False):
        problem = linear(matrix, 2.0, known)
        fit = solve_lm(problem)
        found = what_is_known(problem, fit.values)
        values, square = np.linalg.lstsq(matrix, problem.data[0][0, :, -1].numpy(), rcond=None)[:2]
        np.testing.assert_allclose(fit.values[0], values, rtol=1e-8)
        noise = 2.0 if known else float(np.sqrt(square[0] / 16))
        covariance = np.linalg.inv(matrix.T @ matrix) * noise**2
        sd = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(found.sd[0], sd, rtol=1e-9)
        np.testing.assert_allclose(found.singular_values[0], np.linalg.svd(matrix * 1e-3 / 2.0)[1], rtol=1e-9)
        assert float(found.freedom) == pytest.approx(16)
        assert float(found.noise) == pytest.approx(float(np.sqrt(square[0] / 16)) / 2.0)


def test_what_no_row_sees_is_infinite_and_named() -> None:
    generator = np.random.default_rng(2)
    seen = generator.standard_normal((20, 3)) * 1e5
    # p2 and p4 come only as p2 - 0.72 p4; p5 is in no row.
    matrix = np.column_stack([seen[:, 0], seen[:, 1], seen[:, 2], -0.72 * seen[:, 1], np.zeros(20)])
    problem = linear(matrix)
    fit = solve_lm(problem)
    assert bool(fit.converged.all())
    assert float(fit.values[0, 4]) == 0
    known = what_is_known(problem, fit.values)
    assert known.combinations == ("p2 and p4 only as 1.00 p2 - 0.72 p4", "p5 not at all")
    assert known.identifiable.tolist() == [[True, False, True, False, False]]
    assert [math.isinf(v) for v in known.sd[0].tolist()] == [False, True, False, True, True]
    # The others' errors are those of the problem without the hidden directions.
    without = linear(matrix[:, :3])
    torch.testing.assert_close(known.sd[0, [0, 2]], what_is_known(without, without.start).sd[0, [0, 2]])


def test_a_prior_bounds_what_the_rows_leave_open_but_does_not_identify_it() -> None:
    matrix = np.random.default_rng(3).standard_normal((20, 1)) * 1e5 @ np.array([[1.0, 1.0]])
    problem = dataclasses.replace(linear(matrix), prior_sd=torch.tensor([torch.inf, 2e-4], dtype=torch.float64))
    known = what_is_known(problem, problem.start)
    assert not bool(known.identifiable.any())
    assert known.combinations == ("p1 and p2 only as 1.00 p1 + 1.00 p2",)
    covariance = np.linalg.inv(matrix.T @ matrix + np.diag([0, 2e-4**-2]))
    np.testing.assert_allclose(known.sd[0], np.sqrt(np.diag(covariance)), rtol=1e-6)


def test_what_the_noise_drowns_counts_as_unseen() -> None:
    matrix = np.random.default_rng(4).standard_normal((20, 2)) * [1e5, 1.0]
    known = what_is_known(linear(matrix), torch.zeros(1, 2, dtype=torch.float64))
    assert known.identifiable.tolist() == [[True, False]]
    assert known.combinations == ("p2 not at all",)
    # The same rows with a noise 1e5 times smaller tell of it.
    assert bool(what_is_known(linear(matrix, 1e-5), torch.zeros(1, 2, dtype=torch.float64)).identifiable.all())


def test_without_an_equation_to_spare_only_given_noise_tells() -> None:
    matrix = np.random.default_rng(5).standard_normal((3, 3)) * 1e5
    start = torch.zeros(1, 3, dtype=torch.float64)
    assert bool(torch.isfinite(what_is_known(linear(matrix), start).sd).all())
    open_ = what_is_known(linear(matrix, known=False), start)
    assert bool(torch.isinf(open_.sd).all()) and bool(torch.isinf(open_.noise).all())
    assert open_.combinations == ()
    fewer = what_is_known(linear(matrix[:2]), start)
    assert int(fewer.rank) == 2 and not bool(fewer.identifiable.any())


def test_machines_of_different_knowledge_stand_side_by_side() -> None:
    """One machine measured in a single pose over and over knows less than its neighbour."""
    rows = measured(2, 30, 6)
    joints, pose = rows.joints.clone(), rows.pose.clone()
    joints[1], pose[1] = joints[1, :1], pose[1, :1]
    problem = inverse_problem(rows.mechanism, joints, pose, pose_noise=NOISE)
    known = what_is_known(problem, problem.start)
    assert known.rank.tolist() == [12, 2]
    assert bool(known.identifiable[0].all()) and not bool(known.identifiable[1].any())
    assert len(known.combinations) == 2
    assert known.combinations[0].startswith("l1, L1, A1x, A1y, k1 and gamma1 only as 1.00 l1 ")


def test_tied_and_fixed_parameters_are_known_better() -> None:
    rows = measured(1, 24, 7)
    everything = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    fewer = inverse_problem(
        rows.mechanism, rows.joints, rows.pose, choice=ParameterChoice(tied=["k?"], fixed=["A?y"]), pose_noise=NOISE
    )
    wide, narrow = what_is_known(everything, everything.start), what_is_known(fewer, fewer.start)
    for i, parameter in enumerate(narrow.parameters):
        j = [p.name for p in wide.parameters].index(parameter.name)
        assert float(narrow.sd[0, i]) < float(wide.sd[0, j])


def test_values_out_of_reach_are_refused() -> None:
    rows = measured(1, 24, 8)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    with pytest.raises(InputError, match="machine 1: the residual is not finite where it is linearised"):
        what_is_known(problem, 0.1 * problem.start)
