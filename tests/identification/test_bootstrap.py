"""The spread over redrawn rows against the linearised standard errors."""

from __future__ import annotations

import pytest
import torch
from linkages import NOISE, measured

from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice, inverse_problem, solve_lm, what_is_known
from ccnn_torch.identification.identifiability import bootstrap


def test_it_agrees_with_the_linearised_errors() -> None:
    rows = measured(2, 100, 1)
    weights = torch.ones(2, 100, dtype=torch.float64)
    weights[0, 95:] = 0
    spoilt = rows.pose.clone()
    spoilt[0, 95:] += 1.0
    problem = inverse_problem(rows.mechanism, rows.joints, spoilt, weights, pose_noise=NOISE)
    fit = solve_lm(problem)
    drawn = bootstrap(problem, fit, solve_lm, 200)
    assert drawn.values.shape == (200, 2, 12) and bool(drawn.converged.all())
    ratio = drawn.sd() / what_is_known(problem, fit.values).sd
    # A standard deviation of 200 draws is known to 5 %; the rows' own draw varies by about as much.
    assert bool(((ratio.mean(-1) - 1).abs() < 0.15).all())
    low, high = drawn.interval(0.9)
    inside = ((fit.values > low) & (fit.values < high)).to(torch.float64).mean()
    assert float(inside) > 0.9
    again = bootstrap(problem, fit, solve_lm, 200)
    assert torch.equal(again.values, drawn.values)


def test_a_prior_keeps_pulling_to_where_it_pulled() -> None:
    rows = measured(1, 30, 4)
    choice = ParameterChoice(prior={"*": 1e-6})
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, choice=choice, pose_noise=NOISE)
    drawn = bootstrap(problem, solve_lm(problem), solve_lm, 20)
    assert float((drawn.values - problem.start).abs().max()) < 3e-5


def test_what_cannot_be_drawn_is_refused() -> None:
    rows = measured(1, 30, 5)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    fit = solve_lm(problem)
    with pytest.raises(InputError, match="at least 2 draws"):
        bootstrap(problem, fit, solve_lm, 1)
