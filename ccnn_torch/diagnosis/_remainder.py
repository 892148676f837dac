"""What candidates explain of a residual that others have had their part of; the price of choosing among many."""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis._alone import Own, fit_alone

__all__ = ["Remainder", "Tried", "search_charge"]

_DIGITS = 1e-13


def search_charge(gain: Tensor) -> float:
    """Log odds that a search over a grid costs, `g` squares explained at each value: nothing where all do as well."""
    return math.log(len(gain)) - float(torch.logsumexp((gain - gain.max()) / 2, 0))


class Tried(NamedTuple):
    """Columns of `g` candidates, whitened.

    Attributes:
        factors: the columns, `g x s x c x m`; or, where there is a lead, what it is multiplied by: each of its columns
            by its own, `g x s x k x f`, or all by the same, `g x s x 1 x f`.
        lead: columns that all candidates share, `s x c x k`, or None.
    """

    factors: Tensor
    lead: Tensor | None = None

    @property
    def width(self) -> int:
        """How many columns a candidate has."""
        return self.factors.shape[-1] * (1 if self.lead is None else self.lead.shape[-1])

    def some(self, which: slice | Tensor) -> Tried:
        """Some of the candidates."""
        return Tried(self.factors[which], self.lead)

    def one(self, number: int) -> Tensor:
        """Columns of one candidate, `s x c x m`."""
        mine = self.factors[number]
        return mine if self.lead is None else (self.lead[..., None] * mine[:, None]).flatten(-2)


class _Led(NamedTuple):
    """Sums over the channels of what a lead `s x c x k` is multiplied with: itself, `k x k x s`; what is taken,
    `k x P x s`; and what is left of y, `k x 1 x s`."""

    lead: Tensor
    among: Tensor
    taken: Tensor
    along: Tensor


class Remainder:
    """What nuisance columns with their prior leave of `y`, and of whatever is put beside them."""

    def __init__(self, y: Tensor, nuisance: Tensor) -> None:
        """y: `s x c`; nuisance: `s x c x P`, whitened, in units of their prior scale."""
        self.y = self._whole = y.reshape(-1)
        self._rows = y.shape
        self._taken = y.new_zeros(0, y.numel())
        self._last: _Led | None = None
        self._take(nuisance)

    def beside(self, more: Tensor) -> Remainder:
        """With more nuisance, `s x c x m`."""
        if not more.shape[-1]:
            return self
        other = copy(self)
        other._last = None
        other._take(more)
        return other

    def _take(self, more: Tensor) -> None:
        flat = more.flatten(0, 1)
        cross = self._taken @ flat
        gram = flat.mT @ flat
        # Columns that are the same, far above the noise, would leave no digit of the 1.
        ones = 1 + _DIGITS * gram.diagonal().amax(0, keepdim=True) if len(gram) else gram.diagonal()
        gram = gram - cross.mT @ cross + torch.diag(ones.expand(len(gram)))
        factor = torch.linalg.cholesky(gram)
        # Rows whose Gram matrix is what the nuisance takes out: (I + NᵀN)^-1/2 Nᵀ.
        taken = torch.linalg.solve_triangular(factor, flat.mT - cross.mT @ self._taken, upper=False)
        self._taken = torch.cat([self._taken, taken])
        self.y = self.y - taken.mT @ (taken @ self._whole)

    def gain(self, tried: Tried) -> Tensor:
        """Squares that each candidate explains, `g`."""
        inner, b = self._beside(tried)
        ridge = 1e-6 * inner.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-300)
        inner = inner + torch.diag_embed(ridge[:, None].expand(-1, inner.shape[-1]))
        solved = torch.linalg.solve(inner, b[..., None])[..., 0]
        gain: Tensor = (b * solved).sum(-1)
        return gain

    def log_evidence(self, tried: Tried) -> Tensor:
        """Of each candidate, with one scale of its coefficients about their plausible sizes, `g`."""
        inner, b = self._beside(tried)
        groups = [Own(xx, xy) for xx, xy in zip(inner, b, strict=True)]
        return fit_alone(groups, self._whole @ self.y, float(len(self.y)), 0.0).log_evidence

    def _beside(self, tried: Tried) -> tuple[Tensor, Tensor]:
        """Of the columns, the nuisance taken out of them, among themselves and with y: `g x m x m`, `g x m`."""
        inner, cross, b = (
            self._products(tried.factors) if tried.lead is None else self._led_products(tried.lead, tried.factors)
        )
        return inner - cross.mT @ cross, b

    def _products(self, columns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of columns `g x s x c x m` among themselves, with what is taken, and with y: `g x m x m`, `g x P x m`,
        `g x m`."""
        z = columns.flatten(1, 2)
        count, rows, width = z.shape
        flat = z.transpose(0, 1).reshape(rows, count * width)
        cross = (self._taken @ flat).reshape(-1, count, width).transpose(0, 1)
        return z.mT @ z, cross, (z.mT @ self.y[:, None])[..., 0]

    def _led(self, lead: Tensor) -> _Led:
        """Of a lead `s x c x k`, which is mostly the one that was asked for last."""
        if self._last is None or self._last.lead is not lead:
            rows, channels = self._rows
            taken = (self._taken.reshape(-1, rows, channels).transpose(0, 1) @ lead).permute(2, 1, 0)
            along = (lead.mT @ self.y.reshape(rows, channels, 1)).permute(1, 2, 0)
            self._last = _Led(lead, (lead.mT @ lead).permute(1, 2, 0), taken.contiguous(), along)
        return self._last

    def _led_products(self, lead: Tensor, factors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `_products`: summed over the channels once, and not for every candidate."""
        led = self._led(lead)
        count, rows, own, width = factors.shape
        leads = lead.shape[-1]
        if own > 1:
            # Thousands of tiny products take longer than a few large ones.
            z = (lead[None, ..., None] * factors[:, :, None]).reshape(count, -1, leads * width)
            inner = z.mT @ z
        else:
            # By pairs of factors where these are few, else by candidates.
            alike = factors[:, :, 0]
            if width < leads:
                pairs = (alike[..., None] * alike[..., None, :]).transpose(0, 1).reshape(rows, -1)
                inner = (led.among.flatten(0, 1) @ pairs).reshape(leads, leads, count, width, width)
                inner = inner.permute(2, 0, 3, 1, 4)
            else:
                inner = (alike.mT[:, None, None] @ (led.among[..., None] * alike[:, None, None])).transpose(2, 3)
            inner = inner.reshape(count, leads * width, leads * width)
        flat = factors.permute(2, 1, 0, 3).reshape(own, rows, count * width)
        cross = (
            (led.taken @ flat).reshape(leads, -1, count, width).permute(2, 1, 0, 3).reshape(count, -1, leads * width)
        )
        b = (led.along @ flat).reshape(leads, count, width).transpose(0, 1).reshape(count, leads * width)
        return inner, cross, b
