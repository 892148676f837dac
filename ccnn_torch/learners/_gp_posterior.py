"""A Gaussian process that was conditioned on its rows, as plain tensors: mean, variance, and the module for export.

Everything here is made of matrix products, exponentials, square roots and maxima, which ONNX Runtime has in double.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["KERNELS", "GPNetwork", "covariance", "spread_factor"]

KERNELS = ("matern32", "matern52", "rbf")

# Squared distances below this are rounding; the square root of 0 has no derivative.
_NO_DISTANCE = 1e-30


def covariance(kernel: str, inputs: Tensor, rows: Tensor, length_scale: Tensor, output_scale: Tensor) -> Tensor:
    """Covariance of the function at two sets of points (Rasmussen and Williams 2006, eq. 4.17 and 4.9).

    Args:
        kernel: one of `KERNELS`.
        inputs: `... x s x i` [1], or `i` for a single point.
        rows: `... x n x i` [1].
        length_scale: one an input, `... x 1 x i`, or `i`.
        output_scale: variance of the function, `... x 1 x 1`, or 0-d.

    Returns:
        `... x s x n`, or `n` for a single point.
    """
    one, other = inputs / length_scale, rows / length_scale
    squared = (one * one).sum(-1, keepdim=True) + (other * other).sum(-1).unsqueeze(-2) - 2 * (one @ other.mT)
    if one.dim() == 1:
        squared = squared.squeeze(0)
    squared = squared.clamp_min(_NO_DISTANCE)
    if kernel == "rbf":
        return output_scale * torch.exp(-0.5 * squared)
    scaled = torch.sqrt((3.0 if kernel == "matern32" else 5.0) * squared)
    polynomial = 1 + scaled if kernel == "matern32" else 1 + scaled + scaled * scaled / 3
    return output_scale * polynomial * torch.exp(-scaled)


def spread_factor(covariances: Tensor) -> Tensor:
    """Inverse of the lower Cholesky factor, so that a variance is a sum of squares.

    Args:
        covariances: of the measured rows, noise included, `... x v x v`.

    Returns:
        `... x v x v`; zeros, so that nothing is known, where a matrix has no Cholesky factor.
    """
    identity = torch.eye(covariances.shape[-1], dtype=covariances.dtype, device=covariances.device)
    factor, info = torch.linalg.cholesky_ex(covariances)
    good = (info == 0)[..., None, None]
    inverse = torch.linalg.solve_triangular(torch.where(good, factor, identity), identity, upper=False)
    return torch.where(good, inverse, 0.0)


class GPNetwork(nn.Module):
    """Mean and variance of `o` independent Gaussian processes on shared rows, for one repeat.

    Attributes:
        kernel: one of `KERNELS`.
        rows: training rows, `n x i` [1]; the variance knows of the first `v` alone.
        dual: weights of the rows, `o x n` [1].
        spread: inverse Cholesky factors of the first `v` rows' covariances, `o x v x v`.
        length_scale: `o x i` [1].
        output_scale, noise, constant: variance of the function, of the noise, and the mean far from all rows, `o` [1].
    """

    # Thousands of terms of both signs cancel in a prediction, so that engines which sum in another order agree to
    # fewer digits than for a network of some nodes.
    export_tolerance = 1e-9

    rows: Tensor
    dual: Tensor
    spread: Tensor
    length_scale: Tensor
    output_scale: Tensor
    noise: Tensor
    constant: Tensor

    def __init__(
        self,
        kernel: str,
        rows: Tensor,
        dual: Tensor,
        spread: Tensor,
        length_scale: Tensor,
        output_scale: Tensor,
        noise: Tensor,
        constant: Tensor,
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("rows", rows)
        self.register_buffer("dual", dual)
        self.register_buffer("spread", spread)
        self.register_buffer("length_scale", length_scale)
        self.register_buffer("output_scale", output_scale)
        self.register_buffer("noise", noise)
        self.register_buffer("constant", constant)

    def forward(self, features: Tensor) -> Tensor:
        """features: `... x i`; returns `... x o`."""
        # One output at a time: a derivative of one then costs nothing for the others, and the matrices stay small.
        means = [
            self._covariance(features, self.rows, k) @ self.dual[k] + self.constant[k] for k in range(len(self.dual))
        ]
        return torch.stack(means, -1)

    def variance(self, features: Tensor) -> Tensor:
        """Variance of a newly measured output, noise included; features: `... x i`; returns `... x o`, above 0.

        An upper bound of that of the process: leaving out rows never lowers a variance.
        """
        known = self.rows[: self.spread.shape[-1]]
        variances = []
        for k in range(len(self.dual)):
            told = self._covariance(features, known, k) @ self.spread[k].mT
            left = self.output_scale[k] - (told * told).sum(-1)
            variances.append(left.clamp_min(0.0) + self.noise[k])
        return torch.stack(variances, -1)

    def _covariance(self, features: Tensor, rows: Tensor, output: int) -> Tensor:
        return covariance(self.kernel, features, rows, self.length_scale[output], self.output_scale[output])

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        n, i = self.rows.shape
        return {
            "kind": "gp",
            "kernel": self.kernel,
            "inputs": i,
            "outputs": len(self.dual),
            "rows": n,
            "variance_rows": self.spread.shape[-1],
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> GPNetwork:
        """A module of the described shape, for its tensors to be loaded into."""
        i, o, n, v = (int(description[key]) for key in ("inputs", "outputs", "rows", "variance_rows"))
        shapes = ((n, i), (o, n), (o, v, v), (o, i), (o,), (o,), (o,))
        return cls(str(description["kernel"]), *(torch.ones(shape, dtype=torch.float64) for shape in shapes))
