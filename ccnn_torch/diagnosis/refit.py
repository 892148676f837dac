"""The coefficients of known effects fitted to rows: linear least squares with the diagnosis' priors, a few times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import scales
from ccnn_torch.diagnosis.evidence.marginal_likelihood import fit_sets, grams_of
from ccnn_torch.diagnosis.from_file import Known
from ccnn_torch.diagnosis.residual.linearisation import remainder, signature_at, tangent
from ccnn_torch.diagnosis.residual.noise_estimate import fitted_whitening
from ccnn_torch.diagnosis.residual.whitening import LEAST_FREE, Whitening, moving_channels, reweighted
from ccnn_torch.effects import Acting, Situation

# Gauss-Newton steps; the first comes from the nominal machine.
_ROUNDS = 3


def refit(
    situation: Situation, measured: Tensor, known: Sequence[Known], usable: Tensor, beside: Tensor | None = None
) -> list[Acting]:
    """Fit the coefficients that a file names, with its shapes, to some rows; nothing else of the file is used.

    One group a effect, with a prior about its plausible sizes whose scale is brought to its most probable value, and
    rows that are far off set aside or weighed down, as in the diagnosis.

    Args:
        situation: all rows, `s x n`.
        measured: poses, `s x p` [SI].
        known: effects with shapes.
        usable: rows to fit to, `s` bool.
        beside: columns of what else may be there and is not wanted (frames, lengths), per plausible size, `s x c x P`
            [m, rad], or None.

    Returns:
        The effects with the fitted coefficients; 0 for those that the file does not name.
    """
    acting = [Acting(k.effect, k.shape, torch.zeros_like(k.coefficients)) for k in known]
    white: Whitening | None = None
    for _ in range(_ROUNDS):
        there, target = tangent(situation, remainder(situation, measured, acting), acting)
        columns = [signature_at(situation, there, k.effect, k.shape)[..., list(k.used)] for k in known]
        columns += [] if beside is None else [beside]
        every = torch.cat(columns, -1)
        fine = usable & torch.isfinite(target).all(-1) & torch.isfinite(every).flatten(1).all(-1)
        fine &= torch.isfinite(there.jacobian).flatten(1).all(-1)
        target, every = torch.where(fine[:, None], target, 0.0), torch.where(fine[:, None, None], every, 0.0)
        if white is None:
            channels = moving_channels(situation)
            apart = torch.split(every, [c.shape[-1] for c in columns], -1)
            white = fitted_whitening(target, apart, channels, None, fine)
        white = replace(white, weight=torch.where(fine, white.weight, 0.0))
        ends = torch.tensor([c.shape[-1] for c in columns]).cumsum(0).tolist()
        groups = [torch.arange(e - c.shape[-1], e) for c, e in zip(columns, ends, strict=True) if c.shape[-1]]
        fit = fit_sets(grams_of(white(every), white(target)), [groups], 0.0)
        mean = fit.mean[0]
        acting = [_acting(k, situation, mean[end - len(k.used) : end]) for k, end in zip(known, ends, strict=False)]
        left = (target - every @ mean)[:, white.channels]
        free = 1 - float(fit.effective[0]) / max(float(fine.sum()) * len(white.channels), 1.0)
        white = reweighted(white, left, fine, max(free, LEAST_FREE))
    return acting


def _acting(known: Known, situation: Situation, mean: Tensor) -> Acting:
    """The effect with coefficients in plausible sizes."""
    index = torch.tensor(known.used, dtype=torch.int64)
    size = scales(known.effect.coefficients(situation), mean)
    return Acting(
        known.effect, known.shape, torch.zeros_like(known.coefficients).index_copy(0, index, size[index] * mean)
    )
