"""Levenberg-Marquardt on the weights of masked networks, with Bayesian regularisation.

Half of a network's objective is the misfit, precision of the noise times squared residual; the other half the penalty,
precision of the prior times squared weight. MacKay ("A practical Bayesian framework for backpropagation networks",
Neural Computation 4, 1992) has both precisions from the data alone: of a group of k weights,
gamma = k - alpha trace(H^-1) are determined by the data, and alpha = gamma / sum w^2, beta = (N - gamma) / sum e^2.
Foresee and Hagan ("Gauss-Newton approximation to Bayesian learning", ICNN 1997) take H from the Levenberg-Marquardt
step, as is done here. So a network generalises without rows held out for it.

`refine` does all of it in one call; `pose_refinement`, `start_refinement`, `step_refinement` and `finish_refinement` do
the same in steps, with everything that changes in a `RefinementState` of plain tensors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evolution.gauss_newton import Network, linearise, network_of, prior_groups, residual, wave_groups
from ccnn_torch.evolution.waves import Waves
from ccnn_torch.numerics.trees import chosen, picked, put

# A network whose objective falls by less than this share in so many iterations running is done, and one whose log
# evidence has not risen by 1 nat for so many: it ends with the weights and precisions of the highest evidence.
_TOLERANCE, _CALM, _PATIENCE = 1e-5, 3, 6
WARM_UP = 3
"""Iterations before the first estimate of the precisions."""


@dataclass(frozen=True)
class RefinementProblem:
    """What stays fixed: `b` networks, their data and the settings.

    Attributes:
        network: masks of the `b` networks and what follows from them.
        inputs: `b x s x i`.
        targets: `b x s x o`.
        rows: row weights, `b x s`.
        metric: `b x s x c x o`, or None.
        groups: prior group of every weight, `k`, int64; the last group is never held back.
        group_count: number of prior groups, that last one included.
        wave_groups: which of them are of periodic nodes, int64.
        warm_up: iterations before the first estimate of the precisions.
    """

    network: Network
    inputs: Tensor
    targets: Tensor
    rows: Tensor
    metric: Tensor | None
    groups: Tensor
    group_count: int
    wave_groups: Tensor
    warm_up: int


class RefinementState(NamedTuple):
    """What changes from iteration to iteration.

    Attributes:
        weights: `b x k`.
        damping: `b`.
        prior: precision of each prior group, `b x g`.
        noise: precision of each channel's noise, `b x c`.
        effective: weights determined by the data, per prior group, `b x g`.
        calm: iterations running that lowered the objective by less than the tolerance, `b` int64.
        iteration: iterations done, 0-d, int64.
    """

    weights: Tensor
    damping: Tensor
    prior: Tensor
    noise: Tensor
    effective: Tensor
    calm: Tensor
    iteration: Tensor

    @property
    def done(self) -> Tensor:
        """Networks that do not move any more, `b` bool."""
        return self.calm >= _CALM


class SecondOrder(NamedTuple):
    """Gradient `b x m` and Gauss-Newton matrix `b x m x m` of the objective in the network's kept weights.

    Inactive ones among them have the gradient 0 and 1 on the diagonal. `root` is the matrix's Cholesky factor, and
    `failed` (`b`) not 0 where it has none.
    """

    gradient: Tensor
    matrix: Tensor
    root: Tensor
    failed: Tensor


class Precisions(NamedTuple):
    """What a refinement has estimated beside the weights; 0 = not known.

    Attributes:
        prior: precision of each prior group, `b x g`.
        noise: precision of each channel's noise, `b x c`.
        damping: `b`.
    """

    prior: Tensor
    noise: Tensor
    damping: Tensor


@dataclass(frozen=True)
class Refined:
    """Refined networks.

    Attributes:
        weights: per layer `b x out x in (+ 1)`; those that take no part are as they were given.
        waves: periodic nodes with their refined frequencies, `b x k`.
        log_evidence: logarithm of the probability of the targets given the masks and precisions, up to a constant of
            the data (MacKay 1992, eq. 2.23); compares networks refined on the same rows. `b`.
        precisions: with which it ended.
        iterations: iterations done.
    """

    weights: list[Tensor]
    waves: Waves
    log_evidence: Tensor
    precisions: Precisions
    iterations: int


def part_of_problem(problem: RefinementProblem, index: Tensor) -> RefinementProblem:
    """The problem of some of the networks, numbered as in the batch."""
    if len(index) == len(problem.rows):
        return problem
    parts = {name: picked(getattr(problem, name), index) for name in ("network", "inputs", "targets", "rows", "metric")}
    return replace(problem, **parts)


_PRECISION_RANGE = (1e-8, 1e12)
_DAMPING_RANGE = (1e-12, 1e12)
_VAGUE = 1e-4
# Prior precision before its first estimate, and the first damping, relative to the diagonal of H.
_FIRST_PRIOR, _FIRST_DAMPING = 1e-3, 1e-2
# Gamma distribution that the prior precisions are drawn from; they then are (gamma + 2 shape) / (sum w^2 + 2 rate).
# With a hundred rows and small groups of weights this holds back what the estimate of gamma alone would let through;
# with many rows it makes no difference.
_PRIOR_SHAPE, _PRIOR_RATE = 1.0, 0.1
# Dampings tried in an iteration before it is given up.
_TRIALS = 6
# A rise of the log evidence that is worth an iteration: odds of less than 3 to 1 choose nothing.
_NATS = 1.0


def refine(
    masks: list[Tensor],
    weights: list[Tensor],
    inputs: Tensor,
    targets: Tensor,
    row_weights: Tensor,
    iterations: int = 50,
    row_metric: Tensor | None = None,
    waves: Waves | None = None,
    known: Precisions | None = None,
    warm_up: int = WARM_UP,
) -> Refined:
    """Refine the weights of masked sigmoid networks with linear output; masks stay as they are.

    Nothing is random; no result is NaN where the given networks' outputs are finite; the objective under the precisions
    found in the end is never above that of the given weights.

    Args:
        masks: per layer `b x out x in`, bool.
        weights: per layer `b x out x in + 1`, the last column a bias, always on; or all `b x out x in`.
        inputs: `b x s x i`, about in [-1, 1].
        targets: `b x s x o`, of about unit deviation.
        row_weights: `b x s`; 0 leaves a row out, even with NaN.
        iterations: Levenberg-Marquardt iterations, at most.
        row_metric: `b x s x c x o`: the residual of a row is this matrix times (output - target), so that errors
            are judged in other channels than the outputs' own, as the pose error that joint deviations cause.
        waves: periodic nodes `b x k`, whose columns are last in the output's mask and weights; their frequencies
            are refined as well.
        known: precisions of an earlier refinement to go on from; without them these networks begin anew.
    """
    warm_up = warm_up if known is None else 0
    problem = pose_refinement(masks, weights, inputs, targets, row_weights, row_metric, waves, warm_up)
    state = best = start = start_refinement(problem, weights, waves, known)
    highest = torch.full_like(state.damping, -torch.inf)
    stale = torch.zeros_like(state.calm)
    for _ in range(iterations):
        going = torch.nonzero(~state.done & (stale < _PATIENCE)).flatten()
        if len(going) == 0:
            break
        # Networks do not know of each other, so that those which are done need not be worked on for the others' sake.
        part, now = part_of_problem(problem, going), picked(state, going)
        local = second_order(part, now)
        if int(state.iteration) > warm_up:
            evidence = log_evidence(part, now, local)
            risen = evidence > highest[going]
            best = put(best, going, chosen(risen, now, picked(best, going)))
            much = evidence > highest[going] + _NATS
            stale = stale.index_copy(0, going, torch.where(much, 0, stale[going] + 1))
            highest = highest.index_copy(0, going, torch.where(risen, evidence, highest[going]))
        state = put(state, going, step_refinement(part, now, local))
    if bool((highest > -torch.inf).any()):
        # The last one has not been judged; re-estimated precisions may have taken it downhill.
        last = log_evidence(problem, state, second_order(problem, state))
        worse = torch.nonzero(~(last >= highest) & (highest > -torch.inf)).flatten()
        state = put(state, worse, picked(best, worse))._replace(iteration=state.iteration)
    worse = ~(_objective(problem, state, state.weights) <= _objective(problem, state, start.weights))
    state = state._replace(weights=torch.where(worse.unsqueeze(-1), start.weights, state.weights))
    return finish_refinement(problem, state)


def pose_refinement(
    masks: list[Tensor],
    weights: list[Tensor],
    inputs: Tensor,
    targets: Tensor,
    row_weights: Tensor,
    row_metric: Tensor | None = None,
    waves: Waves | None = None,
    warm_up: int = WARM_UP,
) -> RefinementProblem:
    """The fixed part of a refinement; arguments as in `refine`."""
    there = row_weights > 0
    bias = weights[0].shape[-1] == masks[0].shape[-1] + 1
    slots = 0 if waves is None else waves.frequency.shape[-1]
    groups = prior_groups([m.shape[-2:] for m in masks], bias, slots)
    return RefinementProblem(
        network=network_of(masks, bias, waves),
        inputs=inputs.masked_fill(~there.unsqueeze(-1), 0),
        targets=targets.masked_fill(~there.unsqueeze(-1), 0),
        rows=row_weights,
        metric=None if row_metric is None else row_metric.masked_fill(~there[..., None, None], 0),
        groups=groups.to(row_weights.device),
        group_count=int(groups.max()) + (1 if bias or slots else 2),
        wave_groups=wave_groups(int(groups.max()), masks[-1].shape[-2], slots),
        warm_up=warm_up,
    )


def start_refinement(
    problem: RefinementProblem, weights: list[Tensor], waves: Waves | None = None, known: Precisions | None = None
) -> RefinementState:
    """State before the first iteration. weights: per layer `b x out x in (+ 1)`; waves and known as in `refine`."""
    lines = [] if waves is None else [waves.frequency]
    flat = torch.cat([*(w.flatten(1) for w in weights), *lines], dim=-1)
    batch = flat.shape[0]
    group_count = problem.group_count
    prior = flat.new_full((batch, group_count), _FIRST_PRIOR)
    prior[:, -1] = _PRECISION_RANGE[0]
    channels = problem.targets.shape[-1] if problem.metric is None else problem.metric.shape[-2]
    noise = flat.new_ones(batch, channels)
    effective = flat.new_zeros(batch, group_count)
    state = RefinementState(
        weights=flat,
        damping=flat.new_full((batch,), _FIRST_DAMPING),
        prior=prior,
        noise=noise,
        effective=effective,
        calm=torch.zeros(batch, dtype=torch.int64, device=flat.device),
        # Counted by the host, which need not wait to read it.
        iteration=torch.zeros((), dtype=torch.int64, device="cpu"),
    )
    state = state._replace(noise=_noise(problem, state))
    if known is None:
        return state
    prior, noise, damping = known
    return state._replace(
        prior=torch.where(prior > 0, prior, state.prior),
        noise=torch.where(noise > 0, noise, state.noise),
        damping=torch.where(damping > 0, damping, state.damping),
    )


def step_refinement(problem: RefinementProblem, state: RefinementState, known: SecondOrder) -> RefinementState:
    """One iteration: a damped step that lowers the objective, or none; then new precisions.

    Args:
        known: `second_order` of this state.
    """
    gradient, matrix = known.gradient, known.matrix
    before = _objective(problem, state, state.weights)
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    weights, damping, kept = state.weights, state.damping, problem.network.kept_flat
    reached = before
    todo = torch.arange(len(before), device=before.device)
    for _ in range(_TRIALS):
        damped = matrix[todo]
        damped.diagonal(dim1=-2, dim2=-1).add_(diagonal[todo] * damping[todo].unsqueeze(-1))
        root, failed = torch.linalg.cholesky_ex(damped)
        step = torch.cholesky_solve(gradient[todo].unsqueeze(-1), root).squeeze(-1)
        candidate = state.weights[todo].scatter_add(1, kept[todo], -step)
        after = _objective(part_of_problem(problem, todo), picked(state, todo), candidate)
        good = (failed == 0) & (after < before[todo])
        weights = weights.index_copy(0, todo, torch.where(good.unsqueeze(-1), candidate, weights[todo]))
        reached = reached.index_copy(0, todo, torch.where(good, after, reached[todo]))
        damping = damping.index_copy(0, todo, torch.where(good, damping[todo] / 10, damping[todo] * 10))
        # The host waits for the device here, once a trial: most iterations need one, and none takes up the others.
        todo = todo[~good]
        if len(todo) == 0:
            break
    moved = state._replace(
        weights=weights,
        damping=damping.clamp(*_DAMPING_RANGE),
        calm=torch.where(before - reached < _TOLERANCE * before, state.calm + 1, 0),
        iteration=state.iteration + 1,
    )
    if int(moved.iteration) <= problem.warm_up:
        return moved
    return _estimate_precisions(problem, moved, known)


def finish_refinement(problem: RefinementProblem, state: RefinementState) -> Refined:
    """Weights in their layers and what is known of the fit."""
    return Refined(
        weights=problem.network.split(state.weights),
        waves=Waves(problem.network.source, problem.network.frequencies(state.weights)),
        log_evidence=log_evidence(problem, state, second_order(problem, state)),
        precisions=Precisions(state.prior, state.noise, state.damping),
        iterations=int(state.iteration),
    )


def log_evidence(problem: RefinementProblem, state: RefinementState, known: SecondOrder) -> Tensor:
    """Log evidence of the weights' prior and the noise (Laplace's approximation), but for a constant: `b` [nat].

    -inf where the normal matrix has no Cholesky factor, about which the approximation would be.
    """
    log_determinant = 2 * known.root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    counted = problem.network.active & (problem.groups != state.prior.shape[-1] - 1)
    log_prior = (state.prior.log()[:, problem.groups] * counted).sum(-1)
    log_noise = (state.noise.log() * _row_count(problem).unsqueeze(-1)).sum(-1)
    evidence = (log_prior + log_noise - log_determinant) / 2 - _objective(problem, state, state.weights)
    return torch.where((known.failed == 0) & torch.isfinite(evidence), evidence, -torch.inf)


def second_order(problem: RefinementProblem, state: RefinementState) -> SecondOrder:
    """The objective to second order at a state; most of the work of an iteration."""
    precision = problem.rows.unsqueeze(-1) * state.noise.unsqueeze(1)
    local = linearise(problem.network, state.weights, problem.inputs, problem.targets, problem.metric, precision)
    kept = problem.network.kept_flat
    active = problem.network.active.gather(1, kept)
    prior = state.prior[:, problem.groups].gather(1, kept)
    gradient = local.gradient + torch.where(active, prior * state.weights.gather(1, kept), 0)
    matrix = local.matrix
    matrix.diagonal(dim1=-2, dim2=-1).add_(torch.where(active, prior, 1))
    return SecondOrder(gradient, matrix, *torch.linalg.cholesky_ex(matrix))


def _squares(problem: RefinementProblem, weights: Tensor) -> Tensor:
    """Weighted sum of squared residuals per channel, `b x c`."""
    error = residual(problem.network, weights, problem.inputs, problem.targets, problem.metric)
    return (error.square() * problem.rows.unsqueeze(-1)).sum(1)


def _group_sums(problem: RefinementProblem, values: Tensor, group_count: int) -> Tensor:
    """Sum of `values` (`b x k`) over the active weights of each prior group, `b x g`."""
    values = torch.where(problem.network.active, values, 0)
    return values.new_zeros(values.shape[0], group_count).index_add(1, problem.groups, values)


def _objective(problem: RefinementProblem, state: RefinementState, weights: Tensor) -> Tensor:
    misfit = (_squares(problem, weights) * state.noise).sum(-1)
    penalty = (_group_sums(problem, weights.square(), state.prior.shape[-1]) * state.prior).sum(-1)
    return (misfit + penalty) / 2


def _row_count(problem: RefinementProblem) -> Tensor:
    return problem.rows.sum(-1)


def _noise(problem: RefinementProblem, state: RefinementState) -> Tensor:
    """Noise precision per channel given the effective weights, which the channels share alike."""
    squares = _squares(problem, state.weights)
    channels = squares.shape[-1]
    count = _row_count(problem)
    # More weights than rows may look determined at first; a channel keeps at least a tenth of its rows' freedom.
    free = torch.maximum(count - state.effective.sum(-1) / channels, count / 10).unsqueeze(-1)
    return (free / squares.clamp_min(1e-300)).clamp(*_PRECISION_RANGE)


def _estimate_precisions(problem: RefinementProblem, state: RefinementState, known: SecondOrder) -> RefinementState:
    root, failed = known.root, known.failed
    identity = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    inverse_root = torch.linalg.solve_triangular(root, identity.expand_as(root), upper=False)
    kept = problem.network.kept_flat
    variance = torch.zeros_like(state.weights).scatter(1, kept, inverse_root.square().sum(-2))
    group_count = state.prior.shape[-1]
    determined = 1 - state.prior[:, problem.groups] * variance
    effective = _group_sums(problem, determined, group_count).clamp_min(0)
    squares = _group_sums(problem, state.weights.square(), group_count)
    # A periodic node is there or it is not: nothing is known of its amplitude, and the data alone may switch it off.
    share = torch.ones(group_count, dtype=squares.dtype, device=squares.device)
    share[problem.wave_groups] = _VAGUE
    shape, rate = _PRIOR_SHAPE * share, _PRIOR_RATE * share
    prior = ((effective + 2 * shape) / (squares + 2 * rate)).clamp(*_PRECISION_RANGE)
    prior[:, -1] = _PRECISION_RANGE[0]
    usable = ((failed == 0) & effective.isfinite().all(-1)).unsqueeze(-1)
    estimated = state._replace(
        prior=torch.where(usable, prior, state.prior),
        effective=torch.where(usable, effective, state.effective),
    )
    return estimated._replace(noise=_noise(problem, estimated))
