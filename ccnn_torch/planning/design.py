"""Active calibration: choose poses so that the determinant of the information is largest.

Sun and Hollerbach ("Active robot calibration algorithm", 2008) add and exchange poses one by one and update the
determinant and the inverse instead of computing them anew; here a pose has c rows, so that an update is of rank c, and
the effect of every candidate is known at once. The exchange is that of Cook and Nachtsheim (1980): each chosen pose in
turn is exchanged for the best of all candidates, until no exchange improves the design.

With the covariance V and rows J_i of candidate i, W_ij = J_i V J_jᵀ (c x c): exchanging j for i multiplies the
determinant of the information by
det(I + W_ii) · det(I - W_jj + W_ji (I + W_ii)⁻¹ W_ij). Taking the addition first never divides by a singular matrix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import Progress
from ccnn_torch.numerics.designs import Candidates, forward_substitute, log_determinant, small_cholesky, spread_of, unit

# A gain of the determinant's logarithm that counts, against rounding and endless exchanges.
_GAIN = 1e-9
# Information that the first poses start from where there is no prior, as a share of that of an average pose.
_RIDGE = 1e-6
# Maximum sweeps of exchanges; usually a few are enough.
_SWEEPS = 50


@dataclass
class Design(Candidates):
    """Poses chosen so far, and what each candidate would add. Changes in place.

    Attributes:
        prior: information that is there without any pose, `k x k`.
        chosen: numbers of the chosen candidates, in order.
        free: `M`, bool; which may still be chosen; empty where each may be chosen again.
    """

    prior: Tensor = field(default_factory=lambda: torch.zeros(0, 0))
    chosen: list[int] = field(default_factory=list)
    free: Tensor = field(default_factory=lambda: torch.ones(0, dtype=torch.bool))

    def refresh(self) -> None:
        """Compute inverse and spread anew, which rids them of the rounding of the updates."""
        own = self.rows[:, :, self.chosen].movedim(1, -1).flatten(0, 1)
        self.inverse = torch.cholesky_inverse(torch.linalg.cholesky(self.prior + own.mT @ own))
        self.spread = spread_of(self.rows, self.inverse)


def make_design(rows: Tensor, prior: Tensor | None = None, repeat: bool = False) -> Design:
    """A design without poses.

    Args:
        rows: identification rows of the candidates, `M x c x k` [1].
        prior: information that is there already, `k x k`; very little in every direction when None.
        repeat: whether a candidate may be chosen more than once.
    """
    across = rows.permute(1, 2, 0).contiguous()
    c, k, count = across.shape
    if prior is None:
        prior = _RIDGE * (across.square().sum() / (count * k)) * torch.eye(k, dtype=rows.dtype)
    free = torch.ones(0 if repeat else count, dtype=torch.bool)
    design = Design(across, torch.empty(k, k), torch.empty(c, c, count), prior=prior, free=free)
    design.refresh()
    return design


def add_best(design: Design) -> float:
    """Add the candidate that makes the determinant largest; returns how much its logarithm grew."""
    gain = design.information()
    best = int(_allowed(design, gain).argmax())
    design.change(best, 1)
    _choose(design, best)
    return float(gain[best])


def exchange(design: Design, progress: Progress | None = None) -> bool:
    """Exchange chosen poses for better ones; returns whether no further exchange improves the design."""
    for sweep in range(_SWEEPS):
        design.refresh()
        changed = False
        for place in range(len(design.chosen)):
            changed |= _exchange_one(design, place)
        if progress is not None:
            progress((sweep + 1) / (sweep + 2))
        if not changed:
            return True
    return False


def _exchange_one(design: Design, place: int) -> bool:
    """Exchange the pose at `place` for the best candidate, if that is a gain."""
    old = design.chosen[place]
    factor = design.factor
    added = _allowed(design, log_determinant(factor))
    # An exchange gains at most what the addition does: only candidates that add more than the best exchange found so
    # far need to be evaluated.
    first = added.argmax()[None]
    least = max(float(_exchange_gain(design, old, first, factor, added)), _GAIN)
    worth = torch.nonzero(added > least)[:, 0]
    if len(worth) == 0:
        return False
    gain = _exchange_gain(design, old, worth, factor, added)
    best = int(worth[gain.argmax()])
    if not float(gain.max()) > _GAIN:
        return False
    design.change(best, 1)
    design.change(old, -1)
    if len(design.free):
        design.free[old] = True
    del design.chosen[place]
    _choose(design, best, place)
    return True


def _exchange_gain(design: Design, old: int, new: Tensor, factor: Tensor, added: Tensor) -> Tensor:
    """What `new` candidates (`m`, numbers) in place of `old` add to the determinant's logarithm, `m`.

    factor: Cholesky factors of I + W_ii, `c x c x M`; added: logarithms of their determinants, `M`.
    """
    everything = len(new) > len(added) // 2
    rows, factors = (design.rows, factor) if everything else (design.rows[..., new], factor[..., new])
    cross = (design.rows[:, :, old] @ design.inverse) @ rows
    back = forward_substitute(factors, cross)
    own = design.spread[:, :, old, None]
    left = torch.stack([row + (back[:, a, None] * back).sum(0) for a, row in enumerate(unit(own) - own)])
    gain = log_determinant(small_cholesky(left))
    return added[new] + (gain[new] if everything else gain)


def removal_loss(design: Design) -> Tensor:
    """Loss of the determinant's logarithm when each chosen pose is removed, `N`; inf if it is needed."""
    own = design.spread[..., design.chosen]
    return -log_determinant(small_cholesky(unit(own) - own))


def order_by_worth(rows: Tensor, prior: Tensor) -> tuple[list[int], int]:
    """Order poses so that the first ones alone are good, too: the least informative one comes last, and so on.

    Args:
        rows: of the chosen poses, `N x c x k` [1].
        prior: `k x k`; may be 0.

    Returns:
        The order, and how many of the first are needed before every direction is observable.
    """
    across = rows.permute(1, 2, 0).contiguous()
    k = across.shape[1]
    design = Design(across, prior, across, prior=prior, chosen=list(range(len(rows))))
    last: list[int] = []
    while len(design.chosen) > 1 and len(design.chosen) * len(across) > k - int(torch.linalg.matrix_rank(prior)):
        design.refresh()
        loss = removal_loss(design)
        least = int(loss.argmin())
        if not float(loss[least]) < _NEEDED:
            break
        last.append(design.chosen.pop(least))
    return design.chosen + last[::-1], len(design.chosen)


# A pose whose loss takes a factor of e^-25 from the determinant is the only one that shows some direction.
_NEEDED = 25.0


def tightest_bound(design: Design) -> float:
    """Share of the best possible det^(1/k) that this design reaches at least, of all designs of as many poses.

    By concavity of log det the best design gains at most max_i tr(J_i M⁻¹ J_iᵀ) - k on one with the information M a
    pose (Kiefer and Wolfowitz 1960), repeated poses included. Only for designs without prior.
    """
    k, count = design.inverse.shape[0], len(design.chosen)
    largest = float(design.spread.diagonal(dim1=0, dim2=1).sum(-1).max()) * count
    return min(1.0, float(torch.exp(torch.tensor(1 - largest / k))))


def _allowed(design: Design, gain: Tensor) -> Tensor:
    return torch.where(design.free, gain, -torch.inf) if len(design.free) else gain


def _choose(design: Design, candidate: int, place: int | None = None) -> None:
    design.chosen.insert(len(design.chosen) if place is None else place, candidate)
    if len(design.free):
        design.free[candidate] = False


# Successive poses of small gain before the search for more ends: single gains scatter.
_WINDOW = 3


def observability(jacobian: Tensor, poses: int | Tensor | None = None) -> Tensor:
    """O1 of identification matrices with singular values σ1 ≥ … ≥ σk, (σ1 ⋯ σk)^(1/k) / √poses (Borm and Menq 1991).

    It is 0 where a direction is unobservable. The ranking of poses by it does not depend on the parameters' units (Sun
    and Hollerbach 2008), nor on the divisor.

    Args:
        jacobian: derivatives of all measured channels by the parameters, `... x m x k`; rows of 0 count for nothing.
        poses: number of poses that the rows come from, an integer or `...`; m when None (one channel a pose).

    Returns:
        `...`, larger is better.

    Raises:
        InputError: no parameter.
    """
    m, k = jacobian.shape[-2:]
    if k == 0:
        raise InputError("observability needs an identification matrix with at least one column")
    if m < k:
        jacobian = torch.cat([jacobian, jacobian.new_zeros(*jacobian.shape[:-2], k - m, k)], dim=-2)
    count = torch.as_tensor(m if poses is None else poses, dtype=jacobian.dtype)
    mean: Tensor = torch.linalg.svdvals(jacobian).log().mean(-1).exp()
    return mean / count.sqrt()


@dataclass(frozen=True)
class Gains:
    """Figures of the first n poses of a plan, for `t` values of n.

    Attributes:
        count: number of poses, `t`, int64.
        o1: `observability` of these poses, `t`; parameters in plausible errors, measurements in noise.
        information: det^(1/2k) of the information, `t`: the mean accuracy of the parameters, growing like √poses where
            a pose only averages the noise.
        sd: standard deviation of each parameter, `t x k` [SI].
        largest: the largest of them in plausible errors, `t` [1].
        information_gain: share by which the last pose made `information` larger, `t` [1]; NaN for the first.
        sd_gain: share by which it made `largest` smaller, `t` [1]; NaN for the first.
    """

    count: Tensor
    o1: Tensor
    information: Tensor
    sd: Tensor
    largest: Tensor
    information_gain: Tensor
    sd_gain: Tensor


def gains_of(rows: Tensor, first: int, scale: Tensor, prior_sd: Tensor) -> Gains:
    """The figures of the first n poses for all n from `first` on.

    Args:
        rows: of the poses in order, `N x c x k` [1], in plausible errors.
        first: the least number of poses that make every direction observable.
        scale: plausible errors, `k` [SI].
        prior_sd: standard deviations of the prior, `k` [SI], inf where there is none.
    """
    count = torch.arange(first, len(rows) + 1)
    there = torch.arange(len(rows)) < count[:, None]
    matrices = torch.where(there[:, :, None, None], rows, 0.0).flatten(1, 2)
    return gains_of_sets(matrices, count, scale, prior_sd)


def gains_of_sets(matrices: Tensor, count: Tensor, scale: Tensor, prior_sd: Tensor) -> Gains:
    """The figures of several sets of poses, one after the other.

    Args:
        matrices: identification matrices, `t x m x k` [1], in plausible errors.
        count: poses in each, `t` or one for all.
        scale, prior_sd: as `gains_of`.
    """
    k = matrices.shape[-1]
    held = torch.diag(torch.where(torch.isfinite(prior_sd), scale / prior_sd, 0.0)).expand(len(matrices), k, k)
    whole = torch.cat([matrices, held], dim=1)
    # The triangular factor of the rows, and not their square, so that no digits are lost.
    factor = torch.linalg.qr(whole).R
    information = factor.diagonal(dim1=-2, dim2=-1).abs().log().mean(-1).exp()
    unit = torch.eye(k, dtype=matrices.dtype).expand_as(factor)
    inverse = torch.linalg.solve_triangular(factor, unit, upper=True)
    relative = torch.linalg.vector_norm(inverse, dim=-1)
    largest = relative.amax(-1)
    nan = torch.full((1,), math.nan, dtype=matrices.dtype)
    return Gains(
        count.expand(len(matrices)),
        observability(matrices, count),
        information,
        relative * scale,
        largest,
        torch.cat([nan, information[1:] / information[:-1] - 1]),
        torch.cat([nan, 1 - largest[1:] / largest[:-1]]),
    )


def recommended_count(gains: Gains, least_gain: float) -> int | None:
    """The smallest number of poses after which a further one gives less than `least_gain` (a share).

    Gives: makes the information det^(1/2k) larger and the largest standard deviation smaller, each on average over the
    next three poses. None where even the last poses give more.
    """
    for gain in range(len(gains.count) - _WINDOW):
        ahead = slice(gain + 1, gain + 1 + _WINDOW)
        if max(float(gains.information_gain[ahead].mean()), float(gains.sd_gain[ahead].mean())) < least_gain:
            return int(gains.count[gain])
    return None
