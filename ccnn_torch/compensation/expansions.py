"""Functions of the joints as polynomials that a model file holds."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.domain import Domain, spread_points
from ccnn_torch.errors import InputError, MethodFailedError

_DEGREES = (2, 4, 6, 8, 10, 12, 16)
_MOST_TERMS = 600
# Error of the expansion at points it was not fitted to, as a share of the largest value: what is aimed at, and what is
# still taken. Physical deviations are known to no more than a few per cent themselves.
_AIM, _WORST = 1e-6, 1e-2
# Rows taken, twice, with six times as many points between and around them: three times the most terms.
_SPREAD = 250
# Keeps coefficients that the points do not determine (corners that no pose reaches) small.
_RIDGE = 1e-12


class ChebyshevExpansion(nn.Module):
    """f(q) = Σ c_α Π T_αj(z_j), |α| ≤ degree, with z the joints scaled to [-1, 1] and clamped there.

    Only sums, products and a matrix product, so that it runs wherever a network does.

    Attributes:
        centre, half_range: of the joints, `n` [SI].
        coefficients: `terms x o` [SI].
    """

    centre: Tensor
    half_range: Tensor
    coefficients: Tensor
    _pick: Tensor

    def __init__(self, centre: Tensor, half_range: Tensor, degree: int, outputs: int = 0) -> None:
        """outputs: how many, as many as joints when 0.

        Raises:
            ValueError: the polynomial has more terms than any that is fitted.
        """
        super().__init__()
        if math.comb(len(centre) + degree, degree) > _MOST_TERMS:
            raise ValueError(f"a polynomial of degree {degree} of {len(centre)} joints")
        exponents = _exponents(len(centre), degree)
        self.degree, self.outputs = degree, outputs or len(centre)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half_range)
        self.register_buffer("coefficients", centre.new_zeros(len(exponents), self.outputs))
        pick = torch.nn.functional.one_hot(exponents.mT, degree + 1).mT.to(centre.dtype)
        # `n x (degree + 1) x terms`
        self.register_buffer("_pick", pick.contiguous(), persistent=False)

    def forward(self, joints: Tensor) -> Tensor:
        """joints: `... x n` [SI]; returns `... x o` [SI]."""
        return self.basis(joints) @ self.coefficients

    def basis(self, joints: Tensor) -> Tensor:
        """Products of Chebyshev polynomials, `... x terms` [1]."""
        z = torch.clamp((joints - self.centre) / self.half_range, -1.0, 1.0)
        powers = [torch.ones_like(z), z]
        for _ in range(self.degree - 1):
            powers.append(2.0 * z * powers[-1] - powers[-2])
        table = torch.stack(powers, -1)
        # One matrix product a joint takes its polynomial into every term: narrow engines have no gather.
        product = table[..., 0, :] @ self._pick[0]
        for j in range(1, len(self.centre)):
            product = product * (table[..., j, :] @ self._pick[j])
        return product


def expand(
    function: Callable[[Tensor], Tensor],
    joints: Tensor,
    margin: float = 0.1,
    what: str = "geometric deviation",
    groups: list[int] | None = None,
    worst: float = _WORST,
) -> ChebyshevExpansion:
    """Expand functions of the joints over the domain of the training rows, by least squares, checked at other points.

    Args:
        function: commanded joints `s x n` -> `s x o` [SI]; NaN where the mechanism has no such pose.
        joints: commanded joints of the training rows, `s x n` [SI].
        margin: as in `fit_compensator`.
        groups: widths of neighbouring outputs that share a unit and are judged by their own largest value; all
            together when None.
        worst: error at other points up to which an expansion is taken, as a share of the largest value.

    Raises:
        InputError: the mechanism has more joints than an expansion can have terms for.
        MethodFailedError: no expansion of up to 600 terms is right to `worst`.
    """
    n = joints.shape[-1]
    degrees = [degree for degree in _DEGREES if math.comb(n + degree, n) <= _MOST_TERMS]
    if degrees[-1:] < [4]:
        raise InputError(f"{what}: a mechanism of {n} joints without closed forms cannot be expanded; up to 8 can")
    domain = Domain.fit(joints, torch.zeros_like(joints[0]), margin)
    generator = torch.Generator().manual_seed(2)
    points = torch.cat([spread_points(joints, domain, generator, _SPREAD) for _ in range(2)])
    value = function(points)
    known = torch.isfinite(value).all(-1)
    inside = (domain.excess(domain.cage(points)).squeeze(-1) == 0) & known
    check = torch.arange(len(points)) % 5 == 0
    low, high = points[known].amin(0), points[known].amax(0)
    centre, half = (low + high) / 2, ((high - low) / 2).clamp_min(1e-9)
    outputs = value.shape[-1]
    size = _sizes(value[inside], groups or [outputs])
    if not bool((size > 0).any()):
        return ChebyshevExpansion(centre, half, 2, outputs=outputs)
    # An output that is 0 everywhere stays so.
    scaled = value / torch.where(size > 0, size, 1.0)
    best: tuple[float, ChebyshevExpansion] | None = None
    for degree in degrees:
        found = ChebyshevExpansion(centre, half, degree, outputs=outputs)
        fitted = known & ~check
        # What is beyond the margin only keeps the polynomial tame there.
        root = torch.where(inside[fitted], 1.0, 1e-2).to(value.dtype).unsqueeze(-1)
        basis = found.basis(points[fitted]) * root
        if len(basis) < 2 * basis.shape[-1]:
            break
        normal = basis.mT @ basis
        normal = normal + _RIDGE * normal.diagonal().max() * torch.eye(len(normal), dtype=normal.dtype)
        found.coefficients.copy_(torch.linalg.solve(normal, basis.mT @ (scaled[fitted] * root)))
        other = inside & check
        error = float((found(points[other]) - scaled[other]).abs().max())
        if best is None or error < best[0]:
            best = error, found
        if error <= _AIM:
            break
    if best is None or not best[0] <= worst:
        share = "no number" if best is None else f"{best[0]:.1e}"
        raise MethodFailedError(
            f"the {what} is no polynomial of the joints: the best of degree {degrees[-1]} is off by "
            f"{share} of its largest value, where {worst:g} is allowed; measure a smaller part of the workspace, away "
            "from singular poses, or give a class of your own a closed_form (docs/how_to/mechanisms.md)"
        )
    best[1].coefficients.mul_(size)
    return best[1]


def _sizes(values: Tensor, groups: list[int]) -> Tensor:
    """Largest value of each group of neighbouring outputs, for each of its outputs, `o`."""
    largest = values.abs().amax(0) if len(values) else values.new_zeros(values.shape[-1])
    return torch.cat([part.amax().expand(len(part)) for part in torch.split(largest, groups)])


def _exponents(joints: int, degree: int) -> Tensor:
    """All exponents of total degree up to `degree`, `terms x joints` int64."""
    rows: list[tuple[int, ...]] = [()]
    for _ in range(joints):
        rows = [(*row, k) for row in rows for k in range(degree + 1 - sum(row))]
    return torch.tensor(rows, dtype=torch.int64)
