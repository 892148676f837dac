"""Identified geometry of a mechanism without closed forms as a polynomial: a Chebyshev expansion over the joints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.compensation.geometry.chebyshev import ChebyshevExpansion, expand


class ExpandedGeometry(ChebyshevExpansion):
    """δ(q), commanded joints `... x n` -> `... x n` [SI], as a polynomial.

    Attributes:
        export_tolerance: share of the limit to which exports agree; sums of many terms are rounded.
    """

    export_tolerance = 1e-10

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the tensors are stored beside it."""
        return {"kind": "expanded_geometry", "joints": len(self.centre), "degree": self.degree}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> ExpandedGeometry:
        """An expansion of the described size, 0 everywhere."""
        blank = torch.ones(description["joints"], dtype=torch.float64)
        return cls(blank.clone(), blank.clone(), description["degree"])


def expand_geometry(deviation: Callable[[Tensor], Tensor], joints: Tensor, margin: float = 0.1) -> ExpandedGeometry:
    """Expand a geometric deviation over the domain of the training rows.

    Args:
        deviation: commanded joints `s x n` -> δ `s x n` [SI]; NaN where the mechanism has no such pose.
        joints: commanded joints of the training rows, `s x n` [SI].

    Raises:
        InputError, MethodFailedError: as `expand`.
    """
    found = expand(deviation, joints, margin, "geometric deviation")
    return ExpandedGeometry(found.centre, found.half_range, found.degree, found.coefficients)
