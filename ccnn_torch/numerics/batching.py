"""Broadcasting of leading batch dimensions."""

from __future__ import annotations

import torch
from torch import Tensor


def leading_shape(*tensors: Tensor) -> torch.Size:
    """Common leading dims of tensors `... x d` with any last dims."""
    # Not torch.broadcast_shapes, which loads sympy when first used; numpy's knows no shapes of an export.
    leading = (t.new_empty(()).expand(t.shape[:-1]) for t in tensors)
    shape: torch.Size = torch.broadcast_tensors(*leading)[0].shape  # type: ignore[no-untyped-call]
    return shape


def expand_leading(tensor: Tensor, *others: Tensor) -> Tensor:
    """A tensor `... x d` with its leading dims expanded to those it has in common with the others."""
    return tensor.expand(*leading_shape(tensor, *others), tensor.shape[-1])


def stack_last(*scalars: Tensor) -> Tensor:
    """Broadcast scalars `...` against each other and stack them; returns `... x len(scalars)`."""
    return torch.stack(torch.broadcast_tensors(*scalars), dim=-1)  # type: ignore[no-untyped-call]
