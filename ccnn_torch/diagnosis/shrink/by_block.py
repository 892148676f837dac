"""Share of the gap that is explained in blocks without fitted rows.

Rows dealt at random have neighbours in the fit. Here the rows are sorted along the direction in which the joints vary
most and cut in five blocks: every block is judged by a fit that saw none of it, and the two at the ends by one that has
to extrapolate. Rows that share a frame of their own (a plate set up anew) are cut for themselves, so that every frame
is known from other rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.rows import frame_columns
from ccnn_torch.diagnosis.residual.whitening import ROUNDING
from ccnn_torch.diagnosis.verdict.blocks import Blocks
from ccnn_torch.evidence.marginal_likelihood import fit_sets, grams_of, groups_of
from ccnn_torch.evidence.shrink import FOLDS, HeldOut


def by_block(made: Blocks) -> dict[str, Any] | None:
    """`by_block` of diagnosis.json; None where the verdict names nothing, or there are too few rows for blocks.

    The names and their shapes (periods, lags) are those of all rows; their numbers, and frames that are not known, are
    fitted to the rows outside of the block.

    Args:
        made: the diagnosis' held-out rows, its names and its draws.
    """
    analysis, judgement = made.analysis, made.judgement
    atoms = analysis.atoms
    members = [i for i in judgement.found.members if atoms[i].name in judgement.names]
    white, keep = analysis.whitening, analysis.whitening.keep()
    framed, fresh = white(analysis.fitted)[keep], white(frame_columns(analysis.situation, white.counted))[keep]
    number = cut(analysis.situation.joints[keep], fresh)
    if not members or not bool(torch.bincount(number, minlength=FOLDS).all()):
        return None
    columns = torch.cat([white(atoms[i].columns) for i in members], -1)[keep]
    groups = groups_of(atoms[i].columns for i in members)
    nominal, target = white(made.residual)[keep], white(analysis.residual)[keep]
    before, left, uncertain = nominal.clone(), target.clone(), torch.zeros_like(target)
    for k in range(FOLDS):
        there = number == k
        before[there] = nominal[there] - fresh[there] @ _frames(fresh[~there])(nominal[~there])
        alone = _frames(framed[~there])
        x, y = columns[~there], target[~there]
        # Frames are as large as they have to be: what they can do is no evidence.
        apart, rest = x - framed[~there] @ alone(x), y - framed[~there] @ alone(y)
        fit = fit_sets(grams_of(apart, rest), [groups], analysis.dictionary.noise_dof)
        mean = fit.mean[0]
        frame = alone(y - x @ mean)
        here = columns[there] - framed[there] @ alone(x)
        left[there] = target[there] - columns[there] @ mean - framed[there] @ frame
        uncertain[there] = ((here @ fit.covariance[0]) * here).sum(-1)
    weight = white.weight[keep].sqrt()
    held = HeldOut(left / weight * white.sigma, uncertain / weight.square() * white.sigma.square())
    start = before / weight * white.sigma
    gap = made.main(held, start)
    channels = made.position if bool(made.position.any()) else ~made.position

    def sizes(values: Tensor) -> list[float]:
        squares = values[:, channels].square().sum(-1)
        return [float(squares[number == k].mean().sqrt()) for k in range(FOLDS)]

    return {
        "unit": "m" if bool(made.position.any()) else "rad",
        "before": gap.before,
        "after": gap.after,
        "noise_floor": gap.floor,
        "shrink": gap.shrink,
        "shrink_ci95": None if gap.interval is None else list(gap.interval),
        "blocks": [
            {"rows": int((number == k).sum()), "before": b, "after": a}
            for k, (b, a) in enumerate(zip(sizes(start), sizes(held.left), strict=True))
        ],
    }


def _frames(columns: Tensor) -> Callable[[Tensor], Tensor]:
    """Least-squares coefficients of frames' columns `s x c x r` for values `s x c` or `s x c x m`: `r` or `r x m`."""
    inverse = torch.linalg.pinv(columns.flatten(0, 1), rtol=ROUNDING)
    return lambda values: inverse @ values.flatten(0, 1)


def cut(joints: Tensor, frames: Tensor) -> Tensor:
    """Number of each row's block along the direction in which the joints vary most, `s` int64.

    Args:
        joints: `s x n`; each counts in units of its spread.
        frames: columns of the frames, `s x c x r`: rows with the same ones among them not zero share their frame.
    """
    centred = joints - joints.mean(0)
    scaled = centred / centred.square().mean(0).sqrt().clamp_min(1e-12)
    along = scaled @ torch.linalg.svd(scaled, full_matrices=False)[2][0]
    # One column more that all rows have: there may be no frames at all.
    theirs = torch.nn.functional.pad((frames != 0).any(1), (0, 1), value=True)
    shared = torch.unique(theirs, dim=0, return_inverse=True)[1]
    found = torch.empty_like(shared)
    for group in shared.unique():
        mine = torch.nonzero(shared == group).squeeze(-1)
        order = mine[along[mine].argsort(stable=True)]
        found[order] = torch.arange(len(mine)) * FOLDS // len(mine)
    return found
