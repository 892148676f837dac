"""Active calibration: choose poses so that the determinant of the information is largest.

Sun and Hollerbach ("Active robot calibration algorithm", 2008) add and exchange poses one by one and update the
determinant and the inverse instead of computing them anew; here a pose has c rows, so that an update is of rank c, and
the effect of every candidate is known at once. The exchange is that of Cook and Nachtsheim (1980): each chosen pose in
turn is exchanged for the best of all candidates, until no exchange improves the design.

With information A, V = A⁻¹ and rows J_i of candidate i, W_ij = J_i V J_jᵀ (c x c):
adding i multiplies det A by det(I + W_ii); exchanging j for i multiplies it by
det(I + W_ii) · det(I - W_jj + W_ji (I + W_ii)⁻¹ W_ij). Taking the addition first never divides by a singular matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.identification.problems.problem import Progress

# A gain of the determinant's logarithm that counts, against rounding and endless exchanges.
_GAIN = 1e-9
# Information that the first poses start from where there is no prior, as a share of that of an average pose.
_RIDGE = 1e-6
# Maximum sweeps of exchanges; usually a few are enough.
_SWEEPS = 50


@dataclass
class Design:
    """Poses chosen so far, and what each candidate would add. Changes in place.

    Attributes:
        rows: `c x k x M` [1], in coordinates in which all candidates together give about the same information in every
            direction. The candidates come last so that all work on them is on whole vectors.
        prior: information that is there without any pose, `k x k`.
        chosen: numbers of the chosen candidates, in order.
        free: `M`, bool; which may still be chosen.
        inverse: V, `k x k`.
        spread: W_ii of all candidates, `c x c x M`.
    """

    rows: Tensor
    prior: Tensor
    chosen: list[int]
    free: Tensor
    inverse: Tensor
    spread: Tensor

    def refresh(self) -> None:
        """Compute inverse and spread anew, which rids them of the rounding of the updates."""
        own = self.rows[:, :, self.chosen].movedim(1, -1).flatten(0, 1)
        self.inverse = torch.cholesky_inverse(torch.linalg.cholesky(self.prior + own.mT @ own))
        self.spread = torch.stack([((self.inverse @ row) * self.rows).sum(1) for row in self.rows])

    def change(self, candidate: int, sign: int) -> None:
        """Add a candidate's information (sign 1) or take it away (-1): an update of rank c."""
        own = self.rows[:, :, candidate]
        carried = own @ self.inverse
        middle = torch.eye(len(own), dtype=own.dtype) + sign * carried @ own.mT
        step = torch.linalg.solve_triangular(torch.linalg.cholesky(middle), carried, upper=False)
        self.inverse = self.inverse - sign * step.mT @ step
        moved = step @ self.rows
        for a in range(len(moved)):
            self.spread[a].sub_((moved[a] * moved).sum(1), alpha=sign)


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
    free = torch.ones(count, dtype=torch.bool)
    design = Design(across, prior, [], free, torch.empty(k, k), torch.empty(c, c, count))
    design.free = free if not repeat else torch.ones(0, dtype=torch.bool)
    design.refresh()
    return design


def add_best(design: Design) -> float:
    """Add the candidate that makes the determinant largest; returns how much its logarithm grew."""
    gain = log_determinant(small_cholesky(design.spread + _unit(design.spread)))
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
    factor = small_cholesky(design.spread + _unit(design.spread))
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
    left = torch.stack([row + (back[:, a, None] * back).sum(0) for a, row in enumerate(_unit(own) - own)])
    gain = log_determinant(small_cholesky(left))
    return added[new] + (gain[new] if everything else gain)


def removal_loss(design: Design) -> Tensor:
    """Loss of the determinant's logarithm when each chosen pose is removed, `N`; inf if it is needed."""
    own = design.spread[..., design.chosen]
    return -log_determinant(small_cholesky(_unit(own) - own))


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
    design = Design(across, prior, list(range(len(rows))), torch.ones(0, dtype=torch.bool), prior, across)
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


def _unit(spread: Tensor) -> Tensor:
    return torch.eye(len(spread), dtype=spread.dtype)[:, :, None]


def _allowed(design: Design, gain: Tensor) -> Tensor:
    return torch.where(design.free, gain, -torch.inf) if len(design.free) else gain


def _choose(design: Design, candidate: int, place: int | None = None) -> None:
    design.chosen.insert(len(design.chosen) if place is None else place, candidate)
    if len(design.free):
        design.free[candidate] = False


def small_cholesky(matrix: Tensor) -> Tensor:
    """Lower factors of symmetric matrices `c x c x ...`; NaN where one is not positive definite."""
    c = matrix.shape[0]
    factor = torch.zeros_like(matrix)
    for column in range(c):
        left = factor[column, :column]
        pivot = (matrix[column, column] - left.square().sum(0)).sqrt()
        factor[column, column] = pivot
        for row in range(column + 1, c):
            factor[row, column] = (matrix[row, column] - (factor[row, :column] * left).sum(0)) / pivot
    return factor


def log_determinant(factor: Tensor) -> Tensor:
    """Logarithm of the determinant from lower factors `c x c x ...`; -inf where there is none."""
    total = sum(factor[i, i].log() for i in range(factor.shape[0]))
    return torch.nan_to_num(2 * torch.as_tensor(total), nan=-torch.inf, posinf=-torch.inf)


def forward_substitute(factor: Tensor, right: Tensor) -> Tensor:
    """L⁻¹ right; factor `c x c x ...`, right `c x d x ...`."""
    solved = torch.zeros_like(right)
    for row in range(factor.shape[0]):
        known = (factor[row, :row, None] * solved[:row]).sum(0)
        solved[row] = (right[row] - known) / factor[row, row]
    return solved
