"""Gain of a network on the residual of the effects, on held-out rows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.shrink.held_out import folds
from ccnn_torch.diagnosis.verdict.blocks import noise_floor
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.evidence.marginal_likelihood import fit_sets, without
from ccnn_torch.evidence.shrink import FOLDS, INTERVAL, resampled
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.training import Scaling, train

Progress = Callable[[float], None]
"""Told the share that is done, 0 to 1."""

# Networks of many values (rows times joints) are slow: they are trained without only so many of the folds.
_MANY_VALUES, _FEW_FOLDS = 1500, 2
# Updates of the fit of the effects in each fold.
_UPDATES = 6
# More rows than this, and more outputs (rows times joints), make the training slow: so many are drawn.
_ROWS, _VALUES = 600, 2400
# One coevolution of one structure, as short as it may be: with ten generations, 25 iterations, three searches (many
# outputs: 16 nodes, 15 iterations) what is left is the same within half its interval's width in 35 of 36 cases (33
# simulated remainders, a UR10 with three seeds), at twice the time. Many outputs (an arm) have a period for each joint,
# which takes three searches and few nodes; few outputs have forms that need nodes.
_SETTINGS = CCNNSettings(
    members=1,
    kept=1,
    hidden=(24,),
    rival_hidden=(),
    generations=1,
    refinement_iterations=12,
    wave_searches=2,
    harmonics=0,
)
_SMALL = replace(_SETTINGS, hidden=(12,), generations=10, refinement_iterations=10, wave_searches=3)
_FEW_OUTPUTS = 3
# Remainder above the noise that chance makes, in standard deviations of its mean square.
_CHANCE = 2.0


def with_network(diagnosis: Diagnosis, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """The diagnosis with what a network would still gain; seconds for hundreds of rows.

    Args:
        diagnosis: with its analysis.
        seed: as of the diagnosis.
        progress: called with the share that is done, 0 to 1.
    """
    return diagnosis.with_entries(network=remaining_gain(diagnosis.analysis, diagnosis.judgement, seed, progress))


def remaining_gain(
    analysis: Analysis, judgement: Judgement, seed: int = 0, progress: Progress | None = None
) -> dict[str, Any]:
    """The block `network` of diagnosis.json.

    The verdict's effects are fitted to four fifths of the rows, a CCNN to the joint deviations that make what they
    leave there, over commanded joints and covariates; both are judged on the fifth that neither has seen, five times
    (twice where there are many values).

    Args:
        analysis: of the rows.
        judgement: whose effects count; discrepancy terms do not.
        seed: of folds, network and draws.
        progress: called with the share that is done, 0 to 1.

    Returns:
        `{"unit", "rows", "gap_before", "gap_after", "gap_after_ci95", "gain", "gain_ci95", "reason"}`: RMS over
        held-out rows with the effects and with the network as well, their difference, and intervals from drawing runs
        of rows. `gap_after` and what follows is None where no network was trained, for the `reason` given.
    """
    white = analysis.whitening
    position = white.lengths
    channels = position if bool(position.any()) else ~position
    fold = folds(analysis.situation.joints[white.keep()], seed)
    rows = torch.arange(len(fold))
    most = min(_ROWS, _VALUES // len(analysis.situation.mechanism.joints))
    if len(rows) > most:
        drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))
        rows = drawn[:most].sort().values
    trained = FOLDS if len(rows) * len(analysis.situation.mechanism.joints) <= _MANY_VALUES else _FEW_FOLDS
    left = _left(analysis, judgement, fold, trained)[:, rows]
    judged = torch.nonzero(fold[rows] < trained).squeeze(-1)
    here = (fold[rows][judged], judged)
    before = _squares(left[here], white.sigma, channels)
    noise = float(noise_floor(analysis)[channels].sum())
    block: dict[str, Any] = {
        "unit": "m" if bool(position.any()) else "rad",
        "rows": len(judged),
        "gap_before": math.sqrt(float(before.mean())),
        **dict.fromkeys(("gap_after", "gap_after_ci95", "gain", "gain_ci95")),
        "reason": "",
    }
    chance = float(before.std()) / math.sqrt(len(before))
    if len(analysis.situation.places) > 1:
        return block | {"reason": "each row is of two places, and a network has the joints of one"}
    # Noise that was estimated is what a fit left: only noise that was given says that nothing is left.
    if white.known > 0 and float(before.mean()) < noise + _CHANCE * chance:
        return block | {"reason": "what the effects leave is no more than the noise"}
    said = _predicted(analysis, left, rows, fold, seed, progress)
    after = _squares((left - said)[here], white.sigma, channels)
    many = resampled(len(judged), torch.Generator().manual_seed(seed))
    drawn = after[many].mean(-1).sqrt()
    gain = before[many].mean(-1).sqrt() - drawn
    ends = torch.tensor(INTERVAL, dtype=drawn.dtype)
    reached = math.sqrt(float(after.mean()))
    return block | {
        "gap_after": reached,
        "gap_after_ci95": torch.quantile(drawn, ends).tolist(),
        "gain": block["gap_before"] - reached,
        "gain_ci95": torch.quantile(gain, ends).tolist(),
    }


def _left(analysis: Analysis, judgement: Judgement, fold: Tensor, count: int) -> Tensor:
    """What the effects, fitted without each of `count` folds, leave of all rows in units of the noise, `f x s x c`."""
    dictionary, white = analysis.dictionary, analysis.whitening
    keep = white.keep()
    chosen = [dictionary.groups[i] for i in judgement.found.members if not dictionary.atoms[i].is_discrepancy]
    x, y = dictionary.columns, dictionary.y
    plain_x, plain_y = analysis.plain
    weight = white.weight[keep].sqrt()
    used = torch.cat([torch.arange(0), *chosen])
    left = []
    for k in range(count):
        rest = without(dictionary.grams, x[fold == k], y[fold == k], used)
        fit = fit_sets(rest, [chosen], dictionary.noise_dof, _UPDATES)
        left.append((plain_y - plain_x[..., used] @ fit.mean[0]) / weight)
    return torch.stack(left)


def _predicted(
    analysis: Analysis, left: Tensor, rows: Tensor, fold: Tensor, seed: int, progress: Progress | None
) -> Tensor:
    """What networks trained without each fold say, `f x t x c` in units of the noise.

    Args:
        analysis: of the rows.
        left: of the rows drawn, `f x t x c`.
        rows: which of the rows that count were drawn, `t`.
        fold: of the rows that count, `s`.
        seed: of the networks.
        progress: called with the share that is done.
    """
    white, situation, count = analysis.whitening, analysis.situation, len(left)
    here = white.keep()[rows]
    slope = white.picked(situation.jacobian)[here] / white.sigma[:, None]
    deviation = (torch.linalg.pinv(slope) @ left[..., None])[..., 0]
    joints = situation.joints[here]
    conditions = [v[here] for v in situation.covariates.values() if float(v[here].max() - v[here].min()) > 0]
    inputs = torch.cat([joints, *(v[:, None] for v in conditions)], -1).expand(count, -1, -1)
    turning = torch.tensor([j.unit == "rad" for j in situation.mechanism.joints])
    far = turning & (joints.amax(0) - joints.amin(0) > torch.pi / 2)
    periodic = torch.cat([far, torch.zeros(len(conditions), dtype=torch.bool)])
    weights = torch.where(fold[rows] == torch.arange(count)[:, None], 0.0, white.weight[here].mean(-1))
    scaling = Scaling.fit(inputs, deviation, weights, periodic, angles=True)
    data = TrainingData(
        scaling.features(inputs),
        scaling.standardise(deviation),
        weights,
        seed + torch.arange(count),
        metric=slope * scaling.deviation[:, None, None, :],
        angles=scaling.angle_count,
        angle_step=scaling.angle_step,
    )
    learner = CCNN(_SETTINGS if deviation.shape[-1] <= _FEW_OUTPUTS else _SMALL)
    train(learner, data, callbacks=[] if progress is None else [_Told(progress)])
    return (slope @ scaling.restore(learner.predict(data.inputs))[..., None])[..., 0]


class _Told:
    """Hands the share of steps done on."""

    def __init__(self, progress: Progress) -> None:
        self.progress, self.steps = progress, 1

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        self.steps = max(learner.steps, 1)

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        self.progress(step / self.steps)

    def on_end(self) -> None:
        self.progress(1.0)


def _squares(left: Tensor, sigma: Tensor, channels: Tensor) -> Tensor:
    """Square of what is left of each row in the channels of one unit, `s`; left: `s x c` in units of sigma `c`."""
    squares: Tensor = (left * sigma)[:, channels].square().sum(-1)
    return squares
