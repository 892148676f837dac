"""Functions of a serial arm's joints that are linear in the sine and cosine of each: exactly, from a few samples.

Every joint of an arm enters its forward kinematics as cos q C + sin q S + D (a sliding one as q S + D), so that
places, directions, their derivatives and sums of them are such functions, and 3ⁿ samples determine them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from ccnn_torch.errors import InputError, MethodFailedError

_MOST_JOINTS = 7
# Tolerance, as a share of the largest value, with which a function of this form is reproduced at other joints.
_EXACT = 1e-9


class TrigonometricExpansion(nn.Module):
    """f(q) = Σ c_α Π b_αj(q_j), b = (1, cos q, sin q) of a turning joint, (1, q) of a sliding one.

    Attributes:
        coefficients: `terms x o` [SI]; the last joint's b runs fastest.
    """

    coefficients: Tensor

    def __init__(self, turns: list[bool], outputs: int, coefficients: Tensor | None = None) -> None:
        """turns: which joints turn."""
        super().__init__()
        self.turns = list(turns)
        terms = math.prod(3 if turn else 2 for turn in turns)
        blank = torch.zeros(terms, outputs, dtype=torch.float64)
        self.register_buffer("coefficients", blank if coefficients is None else coefficients)

    def forward(self, joints: Tensor) -> Tensor:
        """joints: `... x n` [SI]; returns `... x o` [SI]."""
        cosine, sine = torch.cos(joints), torch.sin(joints)
        product = torch.ones_like(joints[..., :1])
        for i, turn in enumerate(self.turns):
            one = torch.ones_like(joints[..., i])
            parts = [one, cosine[..., i], sine[..., i]] if turn else [one, joints[..., i]]
            own = torch.stack(parts, -1)
            product = (product.unsqueeze(-1) * own.unsqueeze(-2)).flatten(-2)
        return product @ self.coefficients


def expand_arm(function: Callable[[Tensor], Tensor], turns: list[bool], what: str) -> TrigonometricExpansion:
    """Find the coefficients of functions of this form.

    Args:
        function: joints `s x n` -> `s x o` [SI].
        turns: which of the `n` joints turn.

    Raises:
        InputError: the arm has more than seven joints.
        MethodFailedError: a function is not of this form.
    """
    if len(turns) > _MOST_JOINTS:
        raise InputError(f"{what}: an arm of {len(turns)} joints has too many terms; up to {_MOST_JOINTS} joints can")
    third = 2 * math.pi / 3
    nodes = [torch.tensor([0.0, third, -third] if turn else [-0.5, 0.5], dtype=torch.float64) for turn in turns]
    grid = torch.stack(torch.meshgrid(*nodes, indexing="ij"), -1).reshape(-1, len(turns))
    value = function(grid)
    outputs = value.shape[-1]
    table = value.reshape(*(len(node) for node in nodes), outputs)
    for i, (node, turn) in enumerate(zip(nodes, turns, strict=True)):
        one = torch.ones_like(node)
        own = torch.stack([one, node.cos(), node.sin()] if turn else [one, node], -1)
        table = torch.linalg.solve(own, table.movedim(i, -2)).movedim(-2, i)
    found = TrigonometricExpansion(turns, outputs, table.reshape(-1, outputs).contiguous())
    other = 2 * torch.rand(16, len(turns), generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 1
    error = (found(other) - function(other)).abs().amax(0)
    if not bool((error <= _EXACT * value.abs().max()).all()):
        raise MethodFailedError(f"the {what} is not linear in sine and cosine of the arm's joints")
    return found
