"""An identification problem: free parameters, rows, a residual, its linearisation; split by leg; a solver's fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.numerics.least_squares import jacobian_of

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
        missing: how many channels were not measured in each row, `r x s` (r = 1 where the machines share them); the
            residual is 0 there. None where all were.
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
    missing: Tensor | None = None

    @property
    def equations(self) -> Tensor:
        """Residuals that count of each machine, `r`."""
        used, none = self.weights > 0, torch.zeros(1, 1, dtype=torch.int64)
        return (used * (len(self.channels) - (none if self.missing is None else self.missing))).sum(-1)


def check_equations(problem: Problem) -> None:
    """Refuse a problem with fewer equations than parameters; a prior counts as one equation."""
    rows, equations = int((problem.weights > 0).sum(-1).min()), int(problem.equations.min())
    channels, k = len(problem.channels), len(problem.parameters)
    held = int(torch.isfinite(problem.prior_sd).sum())
    if equations + held < k:
        needed, priors = -(-(k - held) // channels), f" and {held} priors" if held else ""
        raise InputError(
            f"{rows} rows of {count_text(channels, 'equation')}{priors} cannot determine {k} free parameters; "
            f"measure at least {needed} rows beside those that are held out, or fix parameters"
        )


@dataclass(frozen=True)
class Fit:
    """The result of a solver: values, residuals, whether it converged.

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
    """Protocol of a solver: it minimises a problem; all its randomness comes from the seed."""

    def __call__(self, problem: Problem, seed: int, progress: Progress | None = None) -> Fit:
        """Minimise half the weighted sum of squared residuals and prior terms of every machine."""
        ...


# A direction in which the rows leave more than so many plausible errors open (30 mm, 60 mrad) counts as unseen: what a
# linearised problem is not valid so far away.
OPEN = 30.0


def row_jacobian(
    function: Callable[..., Tensor], values: Tensor, data: tuple[Tensor, ...], channels: int
) -> tuple[Tensor, Tensor]:
    """Residual and Jacobian of every row by reverse differentiation, without a graph that could be differentiated.

    Args:
        function: `(values, *data)` -> `... x c`, leading dims independent.
        values: `... x k`, one set for each row.
        data: `... x d` each.
        channels: `c`.

    Returns:
        residual `... x c` and Jacobian `... x c x k`.
    """
    return jacobian_of(lambda point: function(point, *data), values, copies=channels)


class WeightedRows:
    """The rows of a problem that count, ready to be linearised at any values.

    Everything is in units of `problem.scale`: `u = (values - problem.start) / problem.scale`.
    """

    def __init__(self, problem: Problem) -> None:
        used = problem.weights > 0
        kept = used.any(0)
        whole = bool(kept.all())
        self.function = problem.residual
        # A residual that knows which of its entries share no parameter differentiates itself.
        self.quick = getattr(problem.residual, "jacobian", None)
        self.data = problem.data if whole else tuple(d[:, kept] for d in problem.data)
        self.weights = problem.weights if whole else problem.weights[:, kept]
        self.alike = whole and bool((self.weights == 1).all())
        self.channels = len(problem.channels)
        self.equations = problem.equations
        self.scale = problem.scale
        self.start = problem.start
        self.pull = (problem.scale / problem.prior_sd) ** 2
        self.has_prior = bool((self.pull > 0).any())

    def _lead(self, values: Tensor, machines: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Values `r x m x k` and the data of those machines, a row each: `r x m x s x …`."""
        r, m, k = values.shape
        s = self.weights.shape[1]
        data = tuple((d if len(d) == 1 else d[machines])[:, None].expand(r, m, s, -1) for d in self.data)
        return values[:, :, None].expand(r, m, s, k), data

    def residuals(self, values: Tensor, machines: Tensor) -> Tensor:
        """Residual of every row without weights, 0 where the weight is 0: `r x m x s x c` from values `r x m x k`."""
        point, data = self._lead(values, machines)
        with torch.no_grad():
            value = self.function(point, *data)
        return torch.where((self.weights[machines] > 0)[:, None, :, None], value, 0.0)

    def jacobian(self, values: Tensor, machines: Tensor, extra: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Weighted residual `r x m x sc` and its Jacobian in u, `r x m x sc x k`; `extra` weights are `r x m x s`."""
        value, slope = self._rows(values, machines, extra)
        return value, slope * self.scale

    def linearised(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """As `jacobian` at one set of values for each machine, `r x k`: `r x sc` and `r x sc x k`.

        Raises:
            InputError: a residual is not finite there.
        """
        everyone = torch.arange(len(values), device=values.device)
        residual, slope = (part[:, 0] for part in self.jacobian(values[:, None], everyone))
        for lost in torch.nonzero(~torch.isfinite(residual.sum(-1) + slope.abs().sum((-2, -1)))):
            raise InputError(f"machine {int(lost) + 1}: the residual is not finite where it is linearised")
        return residual, slope

    def _rows(self, values: Tensor, machines: Tensor, extra: Tensor | None) -> tuple[Tensor, Tensor]:
        """As `jacobian`, but of the values and not of u."""
        point, data = self._lead(values, machines)
        if self.quick is not None:
            value, slope = self.quick(point, data)
        else:
            value, slope = row_jacobian(self.function, point, data, self.channels)
        if not self.alike or extra is not None:
            weights = self.weights[machines][:, None]
            used = (weights > 0)[..., None]
            root = (weights if extra is None else weights * extra).sqrt()[..., None]
            value = torch.where(used, value * root, 0.0)
            slope = torch.where(used[..., None], slope * root[..., None], 0.0)
        return value.flatten(-2), slope.flatten(-3, -2)

    def normal(self, values: Tensor, machines: Tensor, extra: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Cost `r x m`, gradient `r x m x k` and Gauss-Newton matrix `r x m x k x k` in u, prior included."""
        value, slope = self._rows(values, machines, extra)
        cost = value.square().sum(-1) / 2
        gradient = (value[..., None, :] @ slope)[..., 0, :] * self.scale
        matrix = (slope.mT @ slope) * (self.scale[:, None] * self.scale)
        if self.has_prior:
            u = (values - self.start[machines][:, None]) / self.scale
            cost = cost + (self.pull * u.square()).sum(-1) / 2
            gradient = gradient + self.pull * u
            matrix = matrix + torch.diag(self.pull)
        # Whatever is not finite in a column of the Jacobian is not finite in its square sum.
        sound = torch.isfinite(cost + matrix.diagonal(dim1=-2, dim2=-1).sum(-1))
        return torch.where(sound, cost, torch.inf), gradient, matrix

    def cost(self, values: Tensor, machines: Tensor) -> Tensor:
        """Half the weighted sum of squares, prior included, `r x m`; inf where it is not finite."""
        square = (self.residuals(values, machines).square().sum(-1) * self.weights[machines][:, None]).sum(-1)
        if self.has_prior:
            square = square + (self.pull * ((values - self.start[machines][:, None]) / self.scale).square()).sum(-1)
        return torch.where(torch.isfinite(square), square / 2, torch.inf)


_DEPENDS = 1e-9  # Relative size of a derivative below which it is rounding.


def split_by_leg(problem: Problem) -> list[Problem]:
    """One problem for each leg that has free parameters, in the order of the legs.

    Which channel depends on which leg is read off the Jacobian at the start, not off names.

    Args:
        problem: built with `per_leg=True`: its channels are not decorrelated against each other.

    Raises:
        InputError: a free parameter belongs to no leg, a channel depends on several legs' parameters, a leg's
            parameters move no channel, or a leg has fewer equations than parameters.
    """
    common = [p.name for p in problem.parameters if p.leg is None]
    if common:
        raise InputError(
            f"parameter '{common[0]}' belongs to no single leg, so that the legs cannot be identified apart; fix it, "
            "or identify all legs jointly"
        )
    moved = _moved(problem)
    legs = [p.leg for p in problem.parameters]
    of_channel: list[int | None] = []
    for channel, row in zip(problem.channels, moved.tolist(), strict=True):
        found = sorted({leg for leg, m in zip(legs, row, strict=True) if m and leg is not None})
        if len(found) > 1:
            raise InputError(
                f"channel '{channel.name}' depends on the parameters of legs {', '.join(map(str, found))}, so that the "
                "legs cannot be identified apart; identify them jointly (or, if the noise ties the channels, build the "
                "problem per leg)"
            )
        of_channel.append(found[0] if found else None)
    problems = []
    for leg in sorted({leg for leg in legs if leg is not None}):
        rows = [i for i, found_leg in enumerate(of_channel) if found_leg == leg]
        columns = [i for i, own in enumerate(legs) if own == leg]
        if not rows:
            names = ", ".join(problem.parameters[i].name for i in columns)
            raise InputError(f"no channel depends on the free parameters of leg {leg} ({names}); fix them")
        problems.append(_part(problem, leg, rows, columns))
        check_equations(problems[-1])
    return problems


def _moved(problem: Problem) -> Tensor:
    """Which channels depend on which parameters, at the start of the first machine: `c x k`, bool."""
    rows = WeightedRows(problem)
    slope = rows.jacobian(problem.start[:1, None], torch.zeros(1, dtype=torch.long, device=problem.start.device))[1]
    size = slope.reshape(-1, len(problem.channels), slope.shape[-1]).abs().amax(0)
    return size > _DEPENDS * size.max()


def _part(problem: Problem, leg: int, rows: list[int], columns: list[int]) -> Problem:
    """The problem of some channels and parameters; the other parameters, which do not matter there, stay at a start."""
    pick = torch.zeros(len(columns), len(problem.parameters), dtype=problem.start.dtype, device=problem.start.device)
    pick[torch.arange(len(columns)), columns] = 1
    rest = problem.start[0] * (1 - pick.sum(0))
    whole = problem.residual

    def residual(values: Tensor, *data: Tensor) -> Tensor:
        return whole(values @ pick + rest, *data)[..., rows]

    return dataclasses.replace(
        problem,
        parameters=tuple(problem.parameters[i] for i in columns),
        start=problem.start[:, columns],
        scale=problem.scale[columns],
        prior_sd=problem.prior_sd[columns],
        residual=residual,
        channels=tuple(Channel(problem.channels[i].name, leg) for i in rows),
    )
