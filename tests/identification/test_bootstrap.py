"""The spread over redrawn rows against the linearised standard errors, where those are right, and where not."""

from __future__ import annotations

import pytest
import torch
from linkages import NOISE, measured

from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice, inverse_problem, solve_lm, what_is_known
from ccnn_torch.identification.identifiability import bootstrap


@pytest.mark.parametrize("redraw", ["residuals", "rows"])
def test_it_agrees_with_the_linearised_errors(redraw: str) -> None:
    rows = measured(2, 100, 1)
    weights = torch.ones(2, 100, dtype=torch.float64)
    weights[0, 95:] = 0
    spoilt = rows.pose.clone()
    spoilt[0, 95:] += 1.0
    problem = inverse_problem(rows.mechanism, rows.joints, spoilt, weights, pose_noise=NOISE)
    fit = solve_lm(problem)
    drawn = bootstrap(problem, fit, solve_lm, 200, 0, redraw)
    assert drawn.values.shape == (200, 2, 12) and bool(drawn.converged.all())
    ratio = drawn.sd() / what_is_known(problem, fit.values).sd
    # A standard deviation of 200 draws is known to 5 %; the rows' own draw varies by about as much.
    assert bool(((ratio.mean(-1) - 1).abs() < 0.15).all())
    low, high = drawn.interval(0.9)
    inside = ((fit.values > low) & (fit.values < high)).to(torch.float64).mean()
    assert float(inside) > 0.9
    again = bootstrap(problem, fit, solve_lm, 200, 0, redraw)
    assert torch.equal(again.values, drawn.values)


def test_rows_of_unequal_noise_need_redrawn_rows() -> None:
    """Half the rows ten times as noisy as the others, and the problem does not know."""
    rows = measured(40, 100, 2, noise=0, error=0.2)
    generator = torch.Generator().manual_seed(3)
    loud = torch.where(torch.arange(100) < 10, 1e-3, 1e-4)[:, None]
    pose = rows.clean + loud * torch.randn(rows.clean.shape, generator=generator, dtype=torch.float64)
    choice = ParameterChoice(free=["gamma?", "l?"])
    problem = inverse_problem(rows.mechanism, rows.joints, pose, choice=choice, pose_noise=1e-4, start=rows.truth)
    fit = solve_lm(problem)
    spread = (fit.values - rows.truth[:, [0, 5, 6, 11]]).std(0)
    drawn = bootstrap(problem, fit, solve_lm, 40, 0, "rows").sd().mean(0)
    claimed = what_is_known(problem, fit.values).sd.mean(0)
    assert float((drawn / spread - 1).abs().max()) < 0.35
    assert float((claimed / spread).max()) < 0.5


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
    with pytest.raises(InputError, match="redraw is 'residuals' or 'rows', with at least 2 draws; got 'cases', 10"):
        bootstrap(problem, fit, solve_lm, 10, 0, "cases")
    with pytest.raises(InputError, match="at least 2 draws"):
        bootstrap(problem, fit, solve_lm, 1)
