"""Noise with the form errors of effects and of the nominal model in it, under which sets are weighed again."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evidence.dictionary import CERTAIN
from ccnn_torch.evidence.form_error import DIRECTIONS, OF_EXACT, OF_FORM, form_variance
from ccnn_torch.evidence.marginal_likelihood import Fits, Grams, fit_sets, scaled
from ccnn_torch.motion.effects import EXACT
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Fit
from ccnn_torch.motion.whiten import Whitening

# Share φ of what the nominal model makes of the command: as of an effect, but most of it is right.
_OF_NOMINAL = 1e-5


def form_errors(problem: Problem, whitening: Whitening, best: list[Fit], least: Sequence[float]) -> list[float]:
    """Variance in every direction by which the forms of each axis' set and of the nominal model may be wrong.

    Args:
        problem: the data.
        whitening: of the residual.
        best: a set of each axis.
        least: the variance of each axis is at least that.
    """
    theta = torch.zeros(len(best), problem.library.size, dtype=torch.float64)
    command, names = problem.data.command, problem.library.names
    does, most = (
        problem.whitened(v - command, problem.axes, whitening).square().sum(-1).tolist()
        for v in (problem.positions(theta, problem.axes), problem.data.position)
    )
    found = []
    for i, fit in enumerate(best):
        shares = [OF_EXACT if names[m] in EXACT else OF_FORM for m in fit.members]
        energy = fit_sets(fit.grams, [fit.spec.groups], 0.0).energy[0].tolist()[: len(shares)]
        form = form_variance([*shares, _OF_NOMINAL], [*energy, does[i]], max(most[i], does[i]))
        found.append(max(form, least[i]))
    return found


def weighed(grams: Grams, sets: Sequence[Sequence[Tensor]], columns: int, variance: float) -> Fits:
    """Sets under a noise that is known.

    Args:
        grams: of the columns, and after them of those by which the nominal values may be off, coefficients of standard
            deviation 1: they add to the noise.
        sets: of groups of columns.
        columns: how many are fitted.
        variance: of the noise.
    """
    g = scaled(grams, variance)
    across = torch.cat([g.xx[columns:, :columns], g.xy[columns:, None]], -1)
    inner = g.xx[columns:, columns:] + torch.eye(len(across), dtype=across.dtype)
    taken = across.mT @ torch.linalg.solve(inner, across)
    left = Grams(
        g.xx[:columns, :columns] - taken[:-1, :-1], g.xy[:columns] - taken[:-1, -1], g.yy - taken[-1, -1], g.values
    )
    return fit_sets(left, sets, CERTAIN * grams.values)


def deviations(fit: Fit, variance: float) -> Tensor:
    """Standard deviations of a set's numbers, `m` in plausible sizes, under a noise that holds form errors as well.

    The values of the nominal model are taken for exact here.
    """
    m, grams = len(fit.spec.flat), fit.grams
    own = grams._replace(xx=grams.xx[:m, :m], xy=grams.xy[:m])
    found = weighed(own, [fit.spec.groups], m, max(variance, fit.noise))
    return found.covariance[0, :m, :m].diagonal().clamp_min(0).sqrt()


def unseen_errors(found: Sequence[Sequence[Fit]]) -> list[float]:
    """Variance in every direction by which the best of each axis' sets is worse on runs that it was not fitted to."""
    return [max(min(f.unseen for f in own) - min(f.rss for f in own), 0.0) / DIRECTIONS for own in found]
