"""What the rows determine: standard errors, and hidden directions in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.identification.problems.problem import OPEN, Problem, WeightedRows

# Component of a hidden direction below which a parameter does not take part. Real geometry is never exactly parallel:
# smaller components come from the errors themselves and would tie everything to everything.
TAKES_PART = 1e-2


def combinations_in_words(parameters: Sequence[Parameter], hidden: Tensor, scale: Tensor) -> tuple[str, ...]:
    """A sentence for each group of parameters that hidden directions tie together.

    `A1x and l1 only as 1.00 A1x - 0.72 l1`: of errors of the two, in SI, the rows see this combination and no other.

    Args:
        hidden: directions that the rows do not see, orthonormal or zero, one a row, `… x k`, in units of `scale`.
        scale: `k` [SI].
    """
    rows = hidden.detach().cpu().numpy()
    projector = rows.T @ rows
    part = np.diag(projector) > TAKES_PART**2
    count, group = connected_components((np.abs(projector) > TAKES_PART) & part & part[:, None], directed=False)
    sizes = scale.cpu().numpy()
    sentences = []
    for number in range(count):
        members = np.flatnonzero((group == number) & part).tolist()
        if len(members):
            visible = _visible(projector[np.ix_(members, members)]) / sizes[members]
            sentences.append(_sentence([parameters[i].word or parameters[i].name for i in members], visible))
    return tuple(sentences)


def _visible(projector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Combinations that the rows see, the complement of a group's hidden directions, each with a parameter of its own:
    reduced echelon form, `visible x members`."""
    values, vectors = np.linalg.eigh(projector)
    basis = vectors[:, values < 0.5].T
    if not len(basis):
        return basis
    own = np.sort(qr(basis, mode="economic", pivoting=True)[2][: len(basis)])
    reduced: NDArray[np.float64] = np.linalg.solve(basis[:, own], basis)
    return np.where(np.abs(reduced) < TAKES_PART, 0.0, reduced)


def _sentence(names: list[str], visible: NDArray[np.float64]) -> str:
    everyone = _listed(names)
    if not len(visible):
        return f"{everyone} not at all"
    return f"{everyone} only as {_listed([_combination(names, row) for row in visible])}"


def _combination(names: list[str], row: NDArray[np.float64]) -> str:
    """With 1.00 before its first parameter."""
    taking = np.flatnonzero(row)
    row = row / row[taking[0]]
    text = f"{_number(row[taking[0]])} {names[taking[0]]}"
    for i in taking[1:]:
        text += f" {'-' if row[i] < 0 else '+'} {_number(abs(row[i]))} {names[i]}"
    return text


def _number(value: float) -> str:
    return f"{value:.2f}" if 0.1 <= value < 1000 else f"{value:.3g}"


def _listed(texts: list[str]) -> str:
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


# Singular values below this share of the largest are rounding.
_RANK = 1e-9


@dataclass(frozen=True)
class Knowledge:
    """What rows determine of `r` machines and `k` parameters: standard errors, open directions.

    Attributes:
        parameters: the free ones.
        sd: standard errors, `r x k` [SI], priors included; inf where the rows (and priors) leave a parameter open.
        identifiable: `r x k`, bool: whether the rows alone determine the parameter, without the priors.
        singular_values: of the Jacobian with residuals in their unit and parameters in plausible errors, falling,
            without priors, `r x k` [1].
        rank: how many directions the rows see, `r`.
        combinations: sentences that say what of the parameters left open is known, of the machine of least rank; empty
            where every parameter is identifiable.
        noise: standard deviation of the residuals that the fit leaves, `r`, in their unit: about 1 where the noise was
            given rightly; inf where no equation is to spare.
        freedom: equations less parameters that they determine, `r` [1].
        noise_known: whether the standard errors use the noise given (1) or that of the fit.
    """

    parameters: tuple[Parameter, ...]
    sd: Tensor
    identifiable: Tensor
    singular_values: Tensor
    rank: Tensor
    combinations: tuple[str, ...]
    noise: Tensor
    freedom: Tensor
    noise_known: bool


def what_is_known(problem: Problem, values: Tensor) -> Knowledge:
    """Standard errors and identifiability at some values, from the linearised problem (Gauss-Markov, Cramér-Rao).

    At the true values with the true noise the standard errors are the Cramér-Rao bound. No pseudoinverse: along a
    direction that the rows do not see the uncertainty is infinite, and so is that of every parameter that takes part
    in it. A direction whose standard error would be above 30 plausible errors counts as not seen.
    A parameter takes part in a direction if one plausible error along it moves the parameter by more than a hundredth
    of its own; one that is moved by less keeps a finite error, with that movement in it.

    Args:
        problem: for a robust fit, that of `reweighted`; its standard deviations are then approximate.
        values: `r x k` or `k` [SI].

    Raises:
        InputError: the residual is not finite at these values.
    """
    rows = WeightedRows(problem)
    values = values.expand_as(problem.start)
    residual, slope = rows.linearised(values)
    k = values.shape[-1]
    pull = torch.diag(rows.pull.sqrt()).expand(len(values), k, k)
    _, strength, basis = torch.linalg.svd(_tall(torch.cat([slope, pull], dim=-2)), full_matrices=False)
    freedom, noise = _noise(residual, slope, rows.equations, strength, basis)
    unit = torch.ones_like(noise) if problem.noise_known else noise
    # Without redundant equations the noise is unknown: only rounding then decides what is unobservable.
    least = torch.where(torch.isfinite(unit), unit / OPEN, 0.0)[:, None]

    _, singular, directions = torch.linalg.svd(_tall(slope), full_matrices=False)
    seen = singular > torch.maximum(_RANK * singular[:, :1], least)
    hidden = torch.where(seen[..., None], 0.0, directions)
    identifiable = hidden.square().sum(-2) <= TAKES_PART**2
    open_ = strength <= torch.maximum(_RANK * strength[:, :1], least)
    dragged = torch.where(open_[..., None], basis, 0.0).square().sum(-2)
    left_open = dragged > TAKES_PART**2
    spread = torch.where(open_, 0.0, 1 / strength.clamp_min(1e-300))[..., None] * basis
    covariance = spread.mT @ spread
    root = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    worst = int(seen.sum(-1).argmin())
    return Knowledge(
        parameters=problem.parameters,
        sd=torch.where(left_open, torch.inf, ((unit[:, None] * root).square() + dragged).sqrt() * problem.scale),
        identifiable=identifiable,
        singular_values=singular,
        rank=seen.sum(-1),
        combinations=combinations_in_words(problem.parameters, hidden[worst], problem.scale),
        noise=noise,
        freedom=freedom,
        noise_known=problem.noise_known,
    )


def _noise(
    residual: Tensor, slope: Tensor, equations: Tensor, strength: Tensor, basis: Tensor
) -> tuple[Tensor, Tensor]:
    """Equations to spare and the standard deviation of the residual, `r` each; strength and basis with the priors."""
    inverse = torch.where(strength > _RANK * strength[:, :1], 1 / strength.clamp_min(1e-300), 0.0)
    determined = (slope @ (inverse[..., None] * basis).mT).square().sum((-2, -1))
    # Whole numbers without priors; a remainder of rounding is no equation to spare.
    freedom = equations - determined
    freedom = torch.where(freedom > 1e-6, freedom, 0.0)
    noise = torch.where(freedom > 0, (residual.square().sum(-1) / freedom.clamp_min(1e-6)).sqrt(), torch.inf)
    return freedom, noise


def _tall(matrix: Tensor) -> Tensor:
    """With rows of zeros until there are as many as columns, so that every direction gets a singular value."""
    missing = matrix.shape[-1] - matrix.shape[-2]
    if missing <= 0:
        return matrix
    return torch.cat([matrix, matrix.new_zeros(*matrix.shape[:-2], missing, matrix.shape[-1])], dim=-2)
