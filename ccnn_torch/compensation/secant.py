"""The next step towards a command: Broyden's method, in sums, products, quotients and a maximum.

The correction d of ideal joints q solves d = δ(q - d). The fixed point d ← δ(q - d) gains one factor of δ's slope with
each evaluation of δ. Broyden's "good" method learns that slope from the steps that were done, and each step then gains
more than the one before. It starts from the fixed point and needs no derivative; no matrix is kept, only the steps
(C. T. Kelley, "Iterative methods for linear and nonlinear equations", SIAM 1995, section 7.3).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

# Steps below it are rounding, from which nothing is learned: share of the limit.
_ROUNDING = 1e-10
# A slope of at most 1/2, as compensators have, keeps the denominator above this but for curvature.
_LEAST = 0.5


class Step(NamedTuple):
    """A step in units of the limits, and what gives another vector's share of it, `... x n` each."""

    whole: Tensor
    dual: Tensor


def next_correction(
    deviation: Tensor, correction: Tensor, steps: list[Step], limit: Tensor
) -> tuple[Tensor, list[Step]]:
    """One step of Broyden's method.

    Args:
        deviation: δ(q - correction), `... x n` [SI].
        correction: d, `... x n` [SI]; 0 at first.
        steps: those before, in order; blank ones (zeros) change nothing.
        limit: of |δ|, `n` [SI].

    Returns:
        The next d, and the steps with this one.
    """
    ones = torch.ones_like(limit)
    unit, ones = torch.where(limit > 0, limit, ones), ones.unsqueeze(-1)
    whole = (deviation - correction) / unit
    if steps:
        for before, after in pairwise(steps):
            # Steps shrink, so that the share is below 1 but for rounding, which must not grow.
            whole = whole + after.whole * torch.clamp((before.dual * whole) @ ones, -1.0, 1.0)
        whole = whole / torch.clamp_min(1 - (steps[-1].dual * whole) @ ones, _LEAST)
    # A sum as a product: engines with a narrow operator list have no other reduction.
    dual = whole / ((whole * whole) @ ones + _ROUNDING**2)
    return correction + unit * whole, [*steps, Step(whole, dual)]


@torch.no_grad()
def secant_steps(deviation: Callable[[Tensor], Tensor], joints: Tensor, limit: Tensor, most: int, near: float) -> int:
    """The fewest steps after which d = δ(q - d) holds at all of these joints; `most` where no fewer suffice.

    Args:
        deviation: commanded joints `s x n` -> δ `s x n` [SI].
        joints: `s x n` [SI].
        limit: of |δ|, `n` [SI].
        most: steps that are too many.
        near: how far d and δ may be apart, as a share of the limit; the rounding of a command is allowed for.
    """
    found = deviation(joints)
    correction, steps = torch.zeros_like(found), list[Step]()
    allowed = near * limit + torch.finfo(joints.dtype).eps * joints.abs()
    for count in range(1, most):
        correction, steps = next_correction(found, correction, steps, limit)
        found = deviation(joints - correction)
        if bool(((found - correction).abs() <= allowed).all()):
            return count
    return most
