"""What every effect promises beside a set, by a difference quotient of each."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import fit_sets, grams_of
from ccnn_torch.motion.fit import sensitivities
from ccnn_torch.motion.form import weighed
from ccnn_torch.motion.library import Variant
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Fit
from ccnn_torch.motion.whiten import Whitening

# Difference quotients, for numbers that begin at 0 [plausible sizes].
_STEP = 0.1


def promise(
    problem: Problem, whitening: Whitening, i: int, base: Fit, loose: Tensor, variance: float | None
) -> list[tuple[float, Variant]]:
    """For every variant of an effect that an axis can show and a set lacks, the evidence of both together.

    Args:
        problem: the data.
        whitening: of the residual.
        i: the axis.
        base: its set.
        loose: as of `fit_many`, of this axis.
        variance: of noise and form errors; None: the noise that each set leaves.
    """
    library, theta, flat = problem.library, base.spec.theta, list(base.spec.flat)
    variants = [
        v for own in library.variants for v in own if v.effect not in base.members and bool(library.there[i, v.effect])
    ]
    if not variants:
        return []
    moved, steps = [], []
    for v in variants:
        for a, j in enumerate(v.active):
            changed, value = theta.clone(), float(v.values[i, a])
            steps.append(value if abs(value) > 1e-6 else _STEP)
            changed[j] += steps[-1]
            changed[list(v.held)] = v.shapes[i]
            moved.append(changed)
    residual, own = sensitivities(problem, whitening, theta[None], torch.tensor([i]), [flat])
    axis = torch.full((len(moved),), i)
    left = problem.whitened(problem.residual(torch.stack(moved), axis), axis, whitening)
    new = (residual - left) / left.new_tensor(steps)[:, None]
    x = torch.cat([own[0], new])
    y = residual[0] + theta[flat] @ own[0]
    grams = grams_of(torch.cat([x, loose]).mT[:, None, :], y[:, None])
    grams = grams._replace(values=float(problem.judged.sum()))
    ends = torch.tensor([len(v.active) for v in variants]).cumsum(0) + len(flat)
    sets = [
        [*base.spec.groups, torch.arange(int(end) - len(v.active), int(end))]
        for v, end in zip(variants, ends, strict=True)
    ]
    if variance is None:
        scores = fit_sets(grams, sets, 0.0).log_evidence.tolist()
    else:
        scores = weighed(grams, sets, len(x), variance).log_evidence.tolist()
    return [(s + v.log_prior if math.isfinite(s) else -math.inf, v) for s, v in zip(scores, variants, strict=True)]
