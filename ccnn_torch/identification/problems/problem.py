"""An identification problem: free parameters, rows and a residual; and the fit that a solver returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError

Progress = Callable[[float], None]
"""Told the share that is done, 0 to 1."""


@dataclass(frozen=True)
class Channel:
    """One column of the residual: what it compares, and whose leg's parameters alone it depends on (None = any)."""

    name: str
    leg: int | None = None


@dataclass(frozen=True)
class Problem:
    """Least squares in the `k` free parameters of `r` machines side by side, each with its own `s` rows.

    Attributes:
        parameters: the free ones in order, with units, nominal values and legs.
        start: where a search begins, `r x k` [SI].
        scale: plausible size of each parameter's error, `k` [SI]. Global searches stay within three of them of the
            start; solvers may measure steps by it. It is no prior.
        prior_sd: standard deviation of a Gaussian prior around `start`, `k` [SI]; inf where there is none.
        residual: `(values, *data)` -> `... x c` [1], with values `... x k` and data `... x d`: one row each, leading
            dims independent, differentiable in the values. Divided by its standard deviation and decorrelated, so that
            at the truth its entries are of unit variance (or of one unknown variance, where `noise_known` is false).
        data: what the residual needs of each row, `r x s x d` each (r = 1 where the machines share it).
        weights: `r x s` [1]; 0 leaves a row out.
        channels: the `c` columns of the residual.
        noise_known: whether the residual's unit is the known noise; if not, its variance is estimated from the fit.
    """

    parameters: tuple[Parameter, ...]
    start: Tensor
    scale: Tensor
    prior_sd: Tensor
    residual: Callable[..., Tensor]
    data: tuple[Tensor, ...]
    weights: Tensor
    channels: tuple[Channel, ...]
    noise_known: bool = True


def check_equations(problem: Problem) -> None:
    """Refuse a problem with fewer equations than parameters; a prior counts as one equation."""
    rows = int((problem.weights > 0).sum(-1).min())
    channels, k = len(problem.channels), len(problem.parameters)
    held = int(torch.isfinite(problem.prior_sd).sum())
    if rows * channels + held < k:
        needed = -(-(k - held) // channels)
        raise InputError(
            f"{rows} rows of {channels} equations{f' and {held} priors' if held else ''} cannot determine {k} free "
            f"parameters; measure at least {needed} poses, or fix parameters"
        )


@dataclass(frozen=True)
class Fit:
    """What a solver found.

    Attributes:
        values: `r x k` [SI].
        cost: half the weighted sum of squares there, prior included, `r`.
        converged: `r`, bool.
        evaluations: residuals of all rows of one machine computed, the Jacobians' among them.
        message: one sentence about the first machine that failed; empty when all converged.
    """

    values: Tensor
    cost: Tensor
    converged: Tensor
    evaluations: int
    message: str


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """The progress of one of `count` parts as a share of all; numbered from 0."""
    return None if progress is None else lambda done: progress((number + done) / count)


class Solver(Protocol):
    """A way to minimise a problem; all its randomness comes from the seed."""

    def __call__(self, problem: Problem, seed: int, progress: Progress | None = None) -> Fit:
        """Minimise half the weighted sum of squared residuals and prior terms of every machine."""
        ...
