"""Rows under fits to other rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.evidence.marginal_likelihood import fit_sets, without
from ccnn_torch.evidence.shrink import FOLDS, RUNS, HeldOut
from ccnn_torch.records.splits import number_targets

# Updates of a fit to the first fold, and to the others.
_UPDATES, _MORE = 5, 4


def held_out(analysis: Analysis, sets: Sequence[Sequence[int]], seed: int) -> list[HeldOut]:
    """Refit every set of atoms on four fifths of the rows, five times, each for the fifth that is left.

    Rows are dealt to the folds in runs of neighbours, at random: neighbours in time share more than others do. Where
    rows repeat targets these are dealt whole: a target that was fitted to is no new one.
    """
    keep = analysis.whitening.keep()
    x, y = analysis.dictionary.columns, analysis.dictionary.y
    # What is left of a row is that of the row itself, whatever it shares with others.
    plain_x, plain_y = analysis.plain
    fold = folds(analysis.situation.joints[keep], seed)
    weight = analysis.whitening.weight[keep].sqrt()
    sigma = analysis.whitening.sigma
    left = [y.clone() for _ in sets]
    uncertain = [torch.zeros_like(y) for _ in sets]
    groups = [[analysis.dictionary.groups[i] for i in s] for s in sets]
    used = torch.cat([torch.arange(0), *(analysis.dictionary.groups[i] for i in sorted({i for s in sets for i in s}))])
    order = sorted(range(len(sets)), key=lambda i: sum(map(len, groups[i])))
    parts = [order[i : i + 8] for i in range(0, len(order), 8)]
    reached: dict[int, tuple[Tensor, Tensor]] = {}
    for k in range(FOLDS):
        there = fold == k
        mine = x[there]
        rest = without(analysis.dictionary.grams, mine, y[there], used)
        for part in parts:
            # Folds differ little: the later ones go on from where the one before ended.
            start, updates = reached.get(part[0]), _UPDATES if k == 0 else _MORE
            fits = fit_sets(rest, [groups[i] for i in part], analysis.dictionary.noise_dof, updates, start=start)
            reached[part[0]] = fits.log_scale, fits.noise
            for row, i in enumerate(part):
                columns = torch.cat([torch.arange(0), *groups[i]])
                m = len(columns)
                here = plain_x[there][..., columns]
                left[i][there] = plain_y[there] - here @ fits.mean[row, :m]
                uncertain[i][there] = ((here @ fits.covariance[row, :m, :m]) * here).sum(-1)
    return [
        HeldOut(r / weight * sigma, v / weight.square() * sigma.square()) for r, v in zip(left, uncertain, strict=True)
    ]


def folds(joints: Tensor, seed: int) -> Tensor:
    """Fold of each row of commanded joints `s x n`."""
    generator, rows = torch.Generator().manual_seed(seed), len(joints)
    target = number_targets(joints)
    if target is not None:
        deal: Tensor = torch.randperm(int(target.max()) + 1, generator=generator) % FOLDS
        return deal[target]
    run = max(1, rows // RUNS)
    blocks = -(-rows // run)
    deal = torch.randperm(blocks, generator=generator) % FOLDS
    return deal.repeat_interleave(run)[:rows]
