"""Whitened residuals: decorrelated and of unit variance."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.parameters import Selection
from ccnn_torch.identification.problems.problem import Channel, Problem, check_equations
from ccnn_torch.identification.problems.rows import MeasuredRows, inverse_root
from ccnn_torch.identification.problems.sparse import WhitenedResidual, dependence


class Geometry:
    """The whole geometry from the free values, as cheaply as the choice allows."""

    def __init__(self, selection: Selection, rows: int) -> None:
        spread, fixed = selection.spread, selection.fixed
        square = spread.shape[0] == spread.shape[1]
        self._spread = None if square and bool((spread == torch.eye(len(spread)).to(spread)).all()) else spread
        self._fixed = fixed[0]
        apart = len(fixed) > 1 and bool((fixed != fixed[:1]).any())
        # Fixed parameters that differ between machines travel with the rows; a problem knows no other way.
        self.data: tuple[Tensor, ...] = (fixed[:, None].expand(-1, rows, -1),) if apart else ()

    def __call__(self, values: Tensor, *data: Tensor) -> Tensor:
        """`… x K` from values `… x k` and `self.data`, a row each."""
        if self._spread is None:
            return values
        return values @ self._spread + (data[0] if data else self._fixed)


def whitened_problem(
    gap: Callable[..., Tensor],
    data: tuple[Tensor, ...],
    covariance: Tensor | None,
    rows: MeasuredRows,
    selection: Selection,
    names: Sequence[str],
    what: str,
    noise_known: bool,
    per_leg: bool = False,
) -> Problem:
    """The problem with the residual L⁻¹ gap, L Lᵀ being the noise of a row.

    Args:
        gap: `(values, *data)` -> `… x c` [SI].
        data: `r x s x …`.
        covariance: of a row's gap, broadcasts to `r x s x c x c`; None leaves the gap as it is.
        names: of the `c` entries.
        what: what the entries are, for messages.
        noise_known: whether the covariance is the noise itself or only its proportions.
        per_leg: divide by the diagonal alone, and leave out entries that no free parameter moves.
    """
    if not noise_known and bool(torch.isfinite(selection.prior_sd).any()):
        raise InputError("parameters.prior: a prior can be weighed against the rows only if their noise is given")
    begin = selection.start.expand(rows.machines, -1)
    c = len(names)
    moved = dependence(gap, begin[0], selection.scale, tuple(d[0] for d in data), rows.weights[0] > 0, c)
    kept = [i for i in range(c) if bool(moved[i].any())] if per_leg else list(range(c))
    if not bool(moved.any()):
        free = ", ".join(p.name for p in selection.parameters)
        raise InputError(f"parameters.free: no {what} depends on {free}; free others")
    diagonal = covariance is None or per_leg or bool((covariance == _only_diagonal(covariance)).all())
    whiten: tuple[Tensor, ...] = ()
    if covariance is not None:
        covariance = covariance.expand(1, rows.pose.shape[1], c, c) if covariance.dim() < 4 else covariance
        root = _shared(inverse_root(_only_diagonal(covariance) if diagonal else covariance, rows.weights > 0))
        whiten = (root.diagonal(dim1=-2, dim2=-1)[..., kept] if diagonal else root.flatten(-2),)

    factor = "none" if covariance is None else "diagonal" if diagonal else "full"
    problem = Problem(
        parameters=selection.parameters,
        start=begin,
        scale=selection.scale,
        prior_sd=selection.prior_sd,
        residual=WhitenedResidual(gap, c, kept, factor, moved),
        data=(*data, *whiten),
        weights=rows.weights,
        channels=tuple(Channel(names[i], _leg(selection.parameters, moved[i]) if diagonal else None) for i in kept),
        noise_known=noise_known,
    )
    check_equations(problem)
    return problem


def _only_diagonal(matrix: Tensor) -> Tensor:
    return torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1))


def _leg(parameters: Sequence[Parameter], moved: Tensor) -> int | None:
    legs = {p.leg for p, m in zip(parameters, moved.tolist(), strict=True) if m}
    return legs.pop() if len(legs) == 1 else None


def _shared(table: Tensor) -> Tensor:
    """One copy where all machines have the same."""
    return table[:1] if len(table) > 1 and bool((table == table[:1]).all()) else table
