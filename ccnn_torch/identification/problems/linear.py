"""A problem linearised: residuals and Jacobian of all rows, with their weights."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import Problem

# A direction in which the rows leave more than so many plausible errors open (0.1 m, 0.2 rad) counts as unseen: what a
# linearised problem is not valid so far away.
OPEN = 100.0

# Numbers in the residual's copies below which one backward pass through all of them beats a pass for each channel.
_SMALL = 20_000


def row_jacobian(
    function: Callable[..., Tensor], values: Tensor, data: tuple[Tensor, ...], channels: int | None = None
) -> tuple[Tensor, Tensor]:
    """Residual and Jacobian of every row by reverse differentiation, without a graph that could be differentiated.

    Small batches go through one backward pass, in a copy for each channel: there the time goes with the number of
    operations. Large ones take a pass for each channel.

    Args:
        function: `(values, *data)` -> `... x c`, leading dims independent.
        values: `... x k`, one set for each row.
        data: `... x d` each.
        channels: `c`; found by a call when None.

    Returns:
        residual `... x c` and Jacobian `... x c x k`.
    """
    if channels is None:
        with torch.no_grad():
            channels = function(values[..., :1, :], *(d[..., :1, :] for d in data)).shape[-1]
    together = channels > 1 and values.numel() * channels <= _SMALL
    point = values.detach()
    point = (point.expand(channels, *values.shape) if together else point).clone().requires_grad_()
    with torch.enable_grad():
        value = function(point, *data)
        if together or channels == 1:
            picked = value.diagonal(dim1=0, dim2=-1).sum() if together else value.sum()
            slope = torch.autograd.grad(picked, point, materialize_grads=True)[0]
            return (value[0] if together else value).detach(), slope.movedim(0, -2) if together else slope.unsqueeze(-2)
        columns = [column.sum() for column in value.unbind(-1)]
    parts = [
        torch.autograd.grad(column, point, retain_graph=i + 1 < channels, materialize_grads=True)[0]
        for i, column in enumerate(columns)
    ]
    return value.detach(), torch.stack(parts, dim=-2)


@runtime_checkable
class SparseResidual(Protocol):
    """A residual with a Jacobian of its own."""

    def __call__(self, values: Tensor, *data: Tensor) -> Tensor:
        """As `Problem.residual`."""
        ...

    def jacobian(self, values: Tensor, data: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """As `row_jacobian` of it."""
        ...


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
        self.quick = problem.residual.jacobian if isinstance(problem.residual, SparseResidual) else None
        self.data = problem.data if whole else tuple(d[:, kept] for d in problem.data)
        self.weights = problem.weights if whole else problem.weights[:, kept]
        self.alike = whole and bool((self.weights == 1).all())
        self.channels = len(problem.channels)
        self.equations = used.sum(-1) * self.channels
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
