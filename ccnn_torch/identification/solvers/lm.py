"""Levenberg-Marquardt over machines and starts at once (Levenberg 1944, Marquardt 1963); robust loss, priors."""

from __future__ import annotations

import dataclasses

import torch
from scipy.special import chdtr
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import OPEN, Fit, Problem, Progress, WeightedRows
from ccnn_torch.numerics.least_squares import Trial, damped_step, descend, failures
from ccnn_torch.numerics.outliers import chi_quantile, residual_scale

LOSSES = ("squared", "huber", "cauchy")

# Where the loss bends, in standard deviations of one residual: 95 % efficient with normal noise (Holland and Welsch
# 1977). A row of several channels bends where its length is as rare.
_BEND = {"huber": 1.345, "cauchy": 2.385}


def loss_weights(residual: Tensor, weights: Tensor, loss: str, parameters: int) -> Tensor:
    """Weight of every row under a robust loss, from the length of its residual over the scale of all of them.

    The scale is that of `residual_scale`.

    Args:
        residual: `… x s x c`, decorrelated, its channels of one variance.
        weights: `… x s` [1]; rows with weight 0 do not enter the scale.

    Returns:
        `… x s` in (0, 1].
    """
    if loss == "squared":
        return torch.ones_like(weights).expand(residual.shape[:-1])
    channels = residual.shape[-1]
    used = (weights > 0).expand(residual.shape[:-1])
    length = torch.linalg.vector_norm(residual * weights.sqrt()[..., None], dim=-1)
    scale = residual_scale(length, used, channels, parameters)
    bend = chi_quantile(chdtr(1, _BEND[loss] ** 2), channels)
    ratio = length / (scale * bend).clamp_min(torch.finfo(length.dtype).tiny)
    factor: Tensor = 1 / ratio.clamp_min(1) if loss == "huber" else 1 / (1 + ratio.square())
    return factor


def reweighted(problem: Problem, values: Tensor, loss: str) -> Problem:
    """The problem with the weights that a robust fit ended with, for what is to be known about that fit.

    Args:
        problem: as it was solved.
        values: `r x k` [SI], the fit's.
        loss: the fit's.

    Raises:
        InputError: unknown loss.
    """
    if loss not in LOSSES:
        raise InputError(f"loss is one of {', '.join(LOSSES)}; got '{loss}'")
    rows = WeightedRows(dataclasses.replace(problem, weights=problem.weights.clamp_min(1e-300)))
    everyone = torch.arange(len(values), device=values.device)
    residual = rows.residuals(values[:, None], everyone)[:, 0]
    residual = torch.where((problem.weights > 0)[..., None], residual, 0.0)
    factor = loss_weights(residual, problem.weights, loss, values.shape[-1])
    return dataclasses.replace(problem, weights=problem.weights * factor)


_BLOCK = 400_000  # Numbers in the Jacobian of the machines that are worked on at once: about what caches hold.
_REACH = 3.0  # Starts lie within so many plausible errors.
_ROUNDS = 30  # Of reweighting.
_SETTLED = 1e-4  # Change of the weights below which reweighting ends.
_FIRST_DAMPING, _LIGHT = 1e-8, 1e-2  # The first damping, and one that hardly shortens a step.
_FAR = 30.0  # Plausible errors in one step that make one ask whether its direction is seen at all.
_ROUNDING = 1e-9  # Step in plausible errors that is nothing: 1e-12 m.


def solve_lm(
    problem: Problem,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    starts: int = 1,
    loss: str = "squared",
    max_iterations: int = 60,
    tolerance: float = 1e-4,
) -> Fit:
    """Minimise the problem of every machine from several starts, all in one batch; the best start counts.

    The step solves (JᵀJ + prior + λ max diag(JᵀJ) I) du = -gradient, u being the values in plausible errors. A
    direction that the rows do not see stays where it was, and so does one that they see so faintly that the noise
    would move it by 30 plausible errors. A trial that is worse, or not finite (out of reach), is
    refused and λ grows.

    Args:
        problem: what to minimise.
        seed: of the starts after the first, which is `problem.start`; they are uniform within three plausible errors.
        progress: called with the share of the machines that is done.
        starts: searches of each machine.
        loss: `squared`, `huber` or `cauchy`, by reweighting whole rows (`robust.loss_weights`).
        max_iterations: bound on the trials.
        tolerance: a search ends when the remaining distance, estimated from the decrease of its steps, is below so many
            standard deviations of the estimate.

    Returns:
        Fit; its cost is the squared loss with the problem's weights, and its `evaluations` count a residual and its
        Jacobian as one.

    Raises:
        InputError: an unknown loss, or not one start.
    """
    if loss not in LOSSES or starts < 1:
        raise InputError(f"loss is one of {', '.join(LOSSES)} and starts at least 1; got '{loss}', {starts}")
    rows = WeightedRows(problem)
    machines, k = problem.start.shape
    size = max(1, starts * rows.weights.shape[1] * rows.channels * k)
    everyone = torch.arange(machines, device=problem.start.device)
    blocks = torch.split(everyone, max(1, _BLOCK // size))
    begin = _starts(rows, starts, seed)
    values, cost, converged, count = torch.empty_like(problem.start), [], [], 0
    for block in blocks:
        found = _solve_block(rows, begin[block], block, loss, max_iterations, tolerance)
        values[block] = found[0]
        cost.append(found[1])
        converged.append(found[2])
        count += found[3]
        if progress is not None:
            progress(float(block[-1] + 1) / machines)
    settled = torch.cat(converged)
    total = torch.cat(cost)
    return Fit(values, total, settled, count, failures(settled, total, max_iterations, "machines"))


def _starts(rows: WeightedRows, starts: int, seed: int) -> Tensor:
    """`r x m x k`: the problem's start and draws around it, drawn in halfway until every row is within reach."""
    if starts == 1:
        return rows.start[:, None]
    generator = torch.Generator().manual_seed(seed)
    r, k = rows.start.shape
    draw = torch.rand(r, starts - 1, k, generator=generator, dtype=torch.float64).to(rows.start.device)
    away = torch.cat([torch.zeros_like(rows.start)[:, None], (2 * draw - 1) * (_REACH * rows.scale)], dim=1)
    everyone = torch.arange(r, device=rows.start.device)
    for _ in range(10):
        lost = torch.isinf(rows.cost(rows.start[:, None] + away, everyone))
        if not bool(lost[:, 1:].any()):
            break
        away = torch.where(lost[..., None], away / 2, away)
    return rows.start[:, None] + away


def _solve_block(
    rows: WeightedRows, begin: Tensor, block: Tensor, loss: str, max_iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Values `r x k`, cost `r`, converged `r` and evaluations of some machines."""

    def search(point: Tensor, extra: Tensor | None) -> tuple[Tensor, Tensor, Tensor, int]:
        return _search(rows, point, block, extra, max_iterations, tolerance)

    x, cost, converged, count = search(begin, None)
    best = cost.argmin(-1)
    pick = torch.arange(len(x), device=x.device), best
    x, cost, converged = x[pick], cost[pick], converged[pick]
    if loss == "squared":
        return x, cost, converged, count
    weights = x.new_ones(len(x), 1, rows.weights.shape[1])
    # Cauchy's loss has several minima: it begins where Huber's has settled.
    for kind in ("huber", "cauchy") if loss == "cauchy" else (loss,):
        for _ in range(_ROUNDS):
            fresh = loss_weights(rows.residuals(x[:, None], block), rows.weights[block][:, None], kind, x.shape[-1])
            change = float((fresh - weights).abs().max())
            weights = fresh
            found, _, settled, more = search(x[:, None], weights)
            x, converged, count = found[:, 0], settled[:, 0], count + more
            if change < _SETTLED:
                break
    return x, rows.cost(x[:, None], block)[:, 0], converged, count


def _search(
    rows: WeightedRows, begin: Tensor, block: Tensor, extra: Tensor | None, max_iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Values `r x m x k`, cost `r x m`, converged `r x m` and evaluations of searches from `begin`, `r x m x k`.

    extra: factors of the weights of the rows, `r x 1 x s` where m is 1.
    """
    starts = begin.shape[1]
    machine = block.repeat_interleave(starts)
    free = (rows.equations[machine] - begin.shape[-1]).clamp_min(1)
    least: Tensor | None = None

    def evaluate(values: Tensor, index: Tensor) -> tuple[Tensor, ...]:
        nonlocal least
        weights = None if extra is None else extra[index]
        cost, gradient, matrix = (part[:, 0] for part in rows.normal(values[:, None], machine[index], weights))
        # Of the first cost, for data without noise.
        least = 1e-24 * cost if least is None else least
        return cost, gradient, matrix, 2 * cost / free[index] / OPEN**2

    def step_of(gradient: Tensor, matrix: Tensor, unseen: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
        ridge = (damping * matrix.diagonal(dim1=-2, dim2=-1).amax(-1)).clamp_min(1e-100)
        step, promised = damped_step(matrix, gradient, ridge)
        # Without a factor there is no step: a trial that is not a number is refused, and the damping grows.
        step = torch.where((promised >= 0)[:, None], step, torch.nan)
        far = step.abs().amax(-1) > _FAR
        if bool(far.any()):
            step[far], promised[far] = _seen_step(matrix[far], gradient[far], damping[far], unseen[far])
        return rows.scale * step, promised

    def settled(trial: Trial) -> Tensor:
        assert least is not None
        enough = (tolerance**2 / free[trial.problem] + 1e-13) * trial.cost + least[trial.problem]
        # Steps that fall from one to the next by a ratio leave about the last times that ratio.
        left = trial.promised * (trial.promised / trial.before).clamp_max(1)
        small = (trial.step / rows.scale).abs().amax(-1) <= _ROUNDING
        return (left <= enough) | small & (trial.damping <= _LIGHT)

    found = descend(
        evaluate,
        step_of,
        settled,
        begin.flatten(0, 1),
        damping=_FIRST_DAMPING,
        max_iterations=max_iterations,
        trusting=True,
    )
    shape = len(begin), starts
    return found.value.reshape(begin.shape), found.cost.view(shape), found.converged.view(shape), found.evaluations


def _seen_step(matrix: Tensor, gradient: Tensor, damping: Tensor, unseen: Tensor) -> tuple[Tensor, Tensor]:
    """As `damped_step`, within the eigenvectors of the matrix whose eigenvalue is above `unseen`, `…`."""
    values, vectors = torch.linalg.eigh(torch.nan_to_num(matrix))
    largest = values[..., -1:]
    along = (vectors.mT @ gradient[..., None])[..., 0]
    curvature = values + (damping[..., None] * largest).clamp_min(1e-100)
    part = torch.where(values > torch.maximum(unseen[..., None], 1e-14 * largest), -along / curvature, 0.0)
    step = (vectors @ part[..., None])[..., 0]
    return step, (part * ((curvature - values) * part - along)).sum(-1) / 2
