"""A problem linearised: residuals and Jacobian of all rows, with their weights."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.identification.problem import Problem

__all__ = ["WeightedRows", "row_jacobian"]

# Numbers in the residual's copies below which one backward pass through all of them beats a pass for each channel.
_SMALL = 20_000


def row_jacobian(function: Callable[..., Tensor], values: Tensor, data: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Residual and Jacobian of every row by reverse differentiation, without a graph that could be differentiated.

    Small batches go through one backward pass, in a copy for each channel: there the time goes with the number of
    operations. Large ones take a pass for each channel.

    Args:
        function: `(values, *data)` -> `... x c`, leading dims independent.
        values: `... x k`, one set for each row.
        data: `... x d` each.

    Returns:
        residual `... x c` and Jacobian `... x c x k`.
    """
    with torch.no_grad():
        channels = function(values[..., :1, :], *(d[..., :1, :] for d in data)).shape[-1]
    if values.numel() * channels <= _SMALL:
        point = values.detach().expand(channels, *values.shape).clone().requires_grad_()
        with torch.enable_grad():
            value = function(point, *data)
        pick = torch.eye(channels, dtype=values.dtype, device=values.device)
        pick = pick.reshape(channels, *[1] * (values.dim() - 1), channels).expand_as(value)
        slope = torch.autograd.grad(value, point, pick, materialize_grads=True)[0]
        return value[0].detach(), slope.movedim(0, -2)
    point = values.detach().clone().requires_grad_()
    with torch.enable_grad():
        value = function(point, *data)
        columns = value.unbind(-1)
    units = [torch.ones_like(c) for c in columns]
    parts = [
        torch.autograd.grad(c, point, u, retain_graph=i + 1 < channels, materialize_grads=True)[0]
        for i, (c, u) in enumerate(zip(columns, units, strict=True))
    ]
    return value.detach(), torch.stack(parts, dim=-2)


class WeightedRows:
    """The rows of a problem that count, ready to be linearised at any values.

    Everything is in units of `problem.scale`: `u = (values - problem.start) / problem.scale`.
    """

    def __init__(self, problem: Problem) -> None:
        kept = (problem.weights > 0).any(0)
        whole = bool(kept.all())
        self.function = problem.residual
        self.data = problem.data if whole else tuple(d[:, kept] for d in problem.data)
        self.weights = problem.weights if whole else problem.weights[:, kept]
        self.equations = (self.weights > 0).sum(-1) * len(problem.channels)
        self.channels = len(problem.channels)
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
        value, slope = row_jacobian(self.function, *self._lead(values, machines))
        weights = self.weights[machines][:, None]
        used = (weights > 0)[..., None]
        root = (weights if extra is None else weights * extra).sqrt()[..., None]
        value = torch.where(used, value * root, 0.0)
        slope = torch.where(used[..., None], slope * (root[..., None] * self.scale), 0.0)
        return value.flatten(-2), slope.flatten(-3, -2)

    def normal(self, values: Tensor, machines: Tensor, extra: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Cost `r x m`, gradient `r x m x k` and Gauss-Newton matrix `r x m x k x k` in u, prior included."""
        value, slope = self.jacobian(values, machines, extra)
        cost = value.square().sum(-1) / 2
        gradient = (value[..., None, :] @ slope)[..., 0, :]
        matrix = slope.mT @ slope
        if self.has_prior:
            u = (values - self.start[machines][:, None]) / self.scale
            cost = cost + (self.pull * u.square()).sum(-1) / 2
            gradient = gradient + self.pull * u
            matrix = matrix + torch.diag(self.pull)
        lost = ~(torch.isfinite(cost) & torch.isfinite(matrix).all(-1).all(-1))
        return torch.where(lost, torch.inf, cost), gradient, matrix

    def cost(self, values: Tensor, machines: Tensor) -> Tensor:
        """Half the weighted sum of squares, prior included, `r x m`; inf where it is not finite."""
        square = (self.residuals(values, machines).square().sum(-1) * self.weights[machines][:, None]).sum(-1)
        if self.has_prior:
            square = square + (self.pull * ((values - self.start[machines][:, None]) / self.scale).square()).sum(-1)
        return torch.where(torch.isfinite(square), square / 2, torch.inf)
