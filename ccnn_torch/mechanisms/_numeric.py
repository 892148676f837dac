"""Roots of a loop closure: damped Newton, with the right first derivative."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.batching import leading_shape
from ccnn_torch.least_squares import jacobian_of, levenberg_marquardt

__all__ = ["solve"]

# Residual left [SI] above which a settled search is a least-squares minimum and not a root.
_ROOT = 1e-9


def solve(closure: Callable[..., Tensor], start: Tensor, data: tuple[Tensor, ...]) -> Tensor:
    """The root that damped Newton reaches from `start`.

    Args:
        closure: `(x, *data)` -> `... x c`.
        start: `... x k`, broadcasts with the data.
        data: what the closure needs besides x, `... x d` each.

    Returns:
        `... x k`; NaN in rows without a root. Differentiable in the data by the implicit function theorem (first
        derivatives, forward and reverse mode).
    """
    lead = leading_shape(start, *data)
    plain = tuple(d.detach() for d in data)
    found = levenberg_marquardt(closure, start.detach().expand(*lead, start.shape[-1]), data=plain)
    root = (2 * found.cost).sqrt() <= _ROOT
    x = found.value
    slope = jacobian_of(lambda point: closure(point, *plain), x)[1]
    safe = torch.where((root & torch.isfinite(slope).all(-1).all(-1))[..., None, None], slope, torch.zeros_like(slope))
    # One Newton step from the frozen root: it moves nothing but carries dx = -(dF/dx)⁺ dF. The small ridge keeps a
    # singular configuration finite.
    normal = safe.mT @ safe
    ridge = torch.finfo(x.dtype).eps * normal.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)
    normal = normal + torch.diag_embed(ridge[..., None].expand(*lead, x.shape[-1]))
    step = torch.linalg.solve(normal, safe.mT @ closure(x, *data)[..., None])[..., 0]
    return torch.where(root[..., None], x - step, torch.nan)
