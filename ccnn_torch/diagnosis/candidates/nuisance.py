"""Regression on candidates beside nuisance columns, and the cost of a search among many."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, unflatten

from ccnn_torch.evidence.marginal_likelihood import JITTER, GroupProducts, Prior, fit_single_groups
from ccnn_torch.evidence.priors import WIDE

# Relative ridge of the regression on a candidate.
_RIDGE = 1e-6
FINE, ROUNDS = 9, 5
"""Values between the neighbours of the best of a grid, and how often there are such between those of the last."""


def search_charge(gain: Tensor) -> float:
    """Log odds that a search over a grid costs, `g` squares explained at each value: nothing where all do as well."""
    return math.log(len(gain)) - float(torch.logsumexp((gain - gain.max()) / 2, 0))


@dataclass(frozen=True, eq=False)
class SharedColumns:
    """Columns that many candidates share, whitened, `... x s x c x k`: one object for all that have them, so that what
    is worked out for the first serves the others."""

    columns: Tensor

    @cached_property
    def among(self) -> Tensor:
        """Their products with each other, summed over the channels, `... x k x k x s`."""
        return (self.columns.mT @ self.columns).movedim(-3, -1)


@dataclass(frozen=True, eq=False)
class TrialColumns:
    """Columns of `g` candidates, whitened.

    Attributes:
        factors: the columns, `... x g x s x c x m`; or, where there is a lead, what it is multiplied by: each of its
            columns by its own, `... x g x s x k x f`, or all by the same, `... x g x s x 1 x f`.
        lead: columns that all candidates share, or None.
    """

    factors: Tensor
    lead: SharedColumns | None = None

    @property
    def width(self) -> int:
        """How many columns a candidate has."""
        return self.factors.shape[-1] * (1 if self.lead is None else self.lead.columns.shape[-1])

    def first(self, count: int) -> TrialColumns:
        """The first of the candidates; no leading dimensions."""
        return TrialColumns(self.factors[:count], self.lead)

    def one(self, number: int) -> Tensor:
        """Columns of one candidate, `s x c x m`; no leading dimensions."""
        mine = self.factors[number]
        return mine if self.lead is None else (self.lead.columns[..., None] * mine[:, None]).flatten(-2)

    @cached_property
    def inner(self) -> Tensor:
        """Products of each candidate's columns with each other, `... x g x m x m`."""
        if self.lead is None:
            z = self.factors.flatten(-3, -2)
            return z.mT @ z
        factors, lead = self.factors, self.lead.columns
        own, width, leads = *factors.shape[-2:], lead.shape[-1]
        if own > 1:
            # Thousands of tiny products take longer than a few large ones, and so do short runs that are multiplied.
            z = (lead.repeat_interleave(width, -1).unsqueeze(-4) * factors.flatten(-2).unsqueeze(-2)).flatten(-3, -2)
            return z.mT @ z
        # By pairs of factors where these are few, else by candidates.
        alike, among = factors[..., 0, :], self.lead.among
        if width < leads:
            pairs = (alike[..., None] * alike[..., None, :]).transpose(-4, -3).flatten(-3)
            inner = unflatten(among.flatten(-3, -2) @ pairs, -1, (factors.shape[-4], width, width))
            inner = unflatten(inner, -4, (leads, leads)).movedim(-3, -5).transpose(-3, -2)
        else:
            between = among[..., None, :, :, :, None] * alike[..., None, None, :, :]
            inner = (alike.mT[..., None, None, :, :] @ between).transpose(-3, -2)
        return inner.flatten(-4, -3).flatten(-2)


class _Led(NamedTuple):
    """Sums over the channels of what a lead `... x s x c x k` is multiplied with: what is taken, `... x k x P x s`, and
    what is left of y, `... x k x 1 x s`."""

    taken: Tensor
    along: Tensor


class NuisanceFit:
    """What nuisance columns with their prior leave of `y`, and of any columns put beside them."""

    def __init__(self, y: Tensor, nuisance: Tensor) -> None:
        """y: `s x c`; nuisance: `s x c x P`, whitened, in plausible sizes."""
        self.y = self._whole = y.reshape(-1)
        self._rows = y.shape
        self._taken = y.new_zeros(0, y.numel())
        self._leds: dict[SharedColumns, _Led] = {}
        self._take(nuisance)

    def beside(self, more: Tensor) -> NuisanceFit:
        """With more nuisance, `... x s x c x m`: leading dimensions are those of as many remainders."""
        if not more.shape[-1]:
            return self
        other = copy(self)
        other._leds = {}
        other._take(more)
        return other

    def _take(self, more: Tensor) -> None:
        flat = WIDE * more.flatten(-3, -2)
        cross = self._taken @ flat
        gram = flat.mT @ flat
        if gram.shape[-1]:
            ones = 1 + JITTER * gram.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
            gram = gram - cross.mT @ cross + torch.diag_embed(ones.expand(*gram.shape[:-1]))
        factor = torch.linalg.cholesky(gram)
        # Rows whose Gram matrix is what the nuisance takes out: (I + NᵀN)^-1/2 Nᵀ.
        taken = torch.linalg.solve_triangular(factor, flat.mT - cross.mT @ self._taken, upper=False)
        before = self._taken.expand(*taken.shape[:-2], -1, -1)
        self._taken = torch.cat([before, taken], -2)
        self.y = self.y - (taken.mT @ (taken @ self._whole[..., None]))[..., 0]

    def gain(self, tried: TrialColumns) -> Tensor:
        """Squares that each candidate explains, `... x g`."""
        inner, b = self._beside(tried)
        if b.shape[-1] == 1:
            # As below; the solver takes ten times as long for single numbers.
            return (b.square() / (inner[..., 0] * (1 + _RIDGE)).clamp_min(1e-300))[..., 0]
        ridge = _RIDGE * inner.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-300)
        inner = inner + torch.diag_embed(ridge[..., None].expand(*inner.shape[:-1]))
        solved = torch.linalg.solve(inner, b[..., None])[..., 0]
        gain: Tensor = (b * solved).sum(-1)
        return gain

    def log_evidence(self, tried: TrialColumns, which: Tensor) -> Tensor:
        """Of some candidates, with one scale of the coefficients of each about their plausible sizes; no leading
        dimensions."""
        inner, b = self._beside(tried, which)
        groups = [GroupProducts(xx, xy) for xx, xy in zip(inner, b, strict=True)]
        return fit_single_groups(groups, self._whole @ self.y, Prior(float(len(self.y)), 0.0))[0].log_evidence

    def _beside(self, tried: TrialColumns, which: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Of the columns, the nuisance taken out of them, among themselves and with y: `... x g x m x m`,
        `... x g x m`; which: of the candidates, None = all."""
        inner, factors = (v if which is None else v[which] for v in (tried.inner, tried.factors))
        cross, b = self._crossed(factors) if tried.lead is None else self._led_across(tried.lead, factors)
        return inner - cross.mT @ cross, b

    def _crossed(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Of columns `... x g x s x c x m` with what is taken, and with y: `... x g x P x m`, `... x g x m`."""
        z = columns.flatten(-3, -2)
        flat = z.transpose(-3, -2).flatten(-2)
        cross = unflatten(self._taken @ flat, -1, (z.shape[-3], z.shape[-1])).transpose(-3, -2)
        return cross, (z.mT @ self.y[..., None, :, None])[..., 0]

    def _led(self, lead: SharedColumns) -> _Led:
        if lead not in self._leds:
            columns = lead.columns
            taken = unflatten(self._taken, -1, self._rows).transpose(-3, -2) @ columns
            along = columns.mT @ unflatten(self.y, -1, self._rows)[..., None]
            self._leds[lead] = _Led(taken.movedim(-1, -3).mT.contiguous(), along.movedim(-3, -1))
        return self._leds[lead]

    def _led_across(self, lead: SharedColumns, factors: Tensor) -> tuple[Tensor, Tensor]:
        """As `_crossed`: summed over the channels once, and not for every candidate."""
        led = self._led(lead)
        count, _, own, width = factors.shape[-4:]
        flat = factors.movedim(-4, -2).transpose(-4, -3).flatten(-2)
        if own > 1:
            taken, along = led.taken @ flat, led.along @ flat
        else:
            # One product where all columns have the same factors.
            taken, along = (
                unflatten(led_by.flatten(-3, -2) @ flat[..., 0, :, :], -2, led_by.shape[-3:-1])
                for led_by in (led.taken, led.along)
            )
        cross = unflatten(taken, -1, (count, width)).movedim(-2, -4).transpose(-3, -2).flatten(-2)
        b = unflatten(along[..., 0, :], -1, (count, width)).transpose(-3, -2).flatten(-2)
        return cross, b
