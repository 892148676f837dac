"""Lagged values and velocities from the column of times, without a loop over rows."""

from __future__ import annotations

import torch
from torch import Tensor

# Rows farther apart are not one trajectory [s].
_SAME_MOTION = 1.0


def elapsed(time: Tensor) -> Tensor:
    """Time since the first row, `... x s` [s]."""
    return time - time.amin(-1, keepdim=True)


def lagged(time: Tensor, value: Tensor, lag: Tensor) -> Tensor:
    """A body of one heat capacity behind its surroundings: y' = (value - y) / lag, settled at the first time.

    Exact for a value that is linear between the rows. The recurrence y_k = a_k y_(k-1) + b_k over the rows in the order
    of time is solved by doubling (Hillis and Steele 1986): log2(s) steps for all rows at once, and no exponential of a
    large number, as a running sum would need.

    Args:
        time: `... x s` [s], in any order.
        value: `... x s`.
        lag: `...` [s]; 0 = no lag.

    Returns:
        `... x s`.
    """
    time, value, behind = torch.broadcast_tensors(time, value, lag.unsqueeze(-1))  # type: ignore[no-untyped-call]
    order = torch.argsort(time, dim=-1, stable=True)
    t, v, behind = time.gather(-1, order), value.gather(-1, order), behind[..., 1:].clamp_min(1e-9)
    ratio = t.diff(dim=-1) / behind
    keep = torch.exp(-ratio)
    # Mean of what has passed, weighted by what is kept of it: (1 - e^-r)/r, near 0 by its series.
    small = ratio < 1e-6
    safe = torch.where(small, 1.0, ratio)
    mean = torch.where(small, 1 - ratio / 2, -torch.expm1(-safe) / safe)
    gain = v[..., 1:] * (1 - mean) + v[..., :-1] * (mean - keep)
    factor = torch.cat([torch.zeros_like(v[..., :1]), keep], -1)
    state = torch.cat([v[..., :1], gain], -1)
    reach = 1
    while reach < state.shape[-1]:
        state = torch.cat([state[..., :reach], state[..., reach:] + factor[..., reach:] * state[..., :-reach]], -1)
        factor = torch.cat([factor[..., :reach], factor[..., reach:] * factor[..., :-reach]], -1)
        reach *= 2
    return torch.zeros_like(state).scatter(-1, order, state)


def velocity(time: Tensor, joints: Tensor) -> Tensor:
    """Velocities by differences of the neighbouring rows in time, `... x s x n` [joint's unit per s].

    Rows more than a second from either neighbour are not part of a trajectory: their velocity is 0.

    Args:
        time: `... x s` [s], in any order.
        joints: `... x s x n`.
    """
    if joints.shape[-2] < 2:
        return torch.zeros_like(joints)
    order = torch.argsort(time.expand(joints.shape[:-1]), dim=-1, stable=True)
    t = time.expand(joints.shape[:-1]).gather(-1, order)
    at = order.unsqueeze(-1).expand_as(joints)
    q = joints.gather(-2, at)
    gap = t.diff(dim=-1).unsqueeze(-1)
    moving = (gap > 0) & (gap <= _SAME_MOTION)
    slope = torch.where(moving, q.diff(dim=-2) / torch.where(moving, gap, 1.0), 0.0)
    # The parabola through three rows: each side's slope, weighted by the other side's gap.
    before, after = torch.cat([slope[..., :1, :], slope], -2), torch.cat([slope, slope[..., -1:, :]], -2)
    first, last = torch.cat([gap[..., :1, :], gap], -2), torch.cat([gap, gap[..., -1:, :]], -2)
    known = torch.cat([moving[..., :1, :], moving], -2) & torch.cat([moving, moving[..., -1:, :]], -2)
    whole = (first + last).clamp_min(1e-300)
    middle = torch.where(known, (before * last + after * first) / whole, 0.0)
    return torch.zeros_like(joints).scatter(-2, at, middle)
