"""Gaussian processes: covariance, log marginal likelihood and its slope, and the conditioned process as a module.

The hyperparameters of one process are `k = i + 3` numbers: the logarithms of `i` length scales and of the variance of
the function, the logarithm of (the variance of the noise - `NOISE_FLOOR`), and the mean.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.errors import ModelFileError

NOISE_FLOOR = 1e-6
"""Smallest variance of the noise, as a share of the variance of an output; keeps matrices regular."""
# Matérn's kernel of order 3/2. On a UR10 its marginal likelihood is higher than that of order 5/2, with the same error
# on rows held out (0.068 of the variance; of squared exponentials 0.143); on the tripod they are alike.
_KERNEL = "matern32"
# Priors, for features in [-1, 1] and standardised targets, normal in the logarithms, so that the most probable value is
# the median: in the values themselves the density of a wide log-normal peaks far below it, and with short length scales
# sixty rows of noise alone cost 5 % of an output's variance instead of 1 %. Mean and spread of the logarithm of length
# scales, in units of the square root of the number of inputs, with which distances grow (Hvarfner, Hellsten and Nardi,
# "Vanilla Bayesian Optimization Performs Great in High Dimensions", ICML 2024), and of the two variances.
_LENGTH, _SCALE, _NOISE = (math.log(4.0), 1.0), (-1.0, 1.5), (-2.0, 2.0)
# Squared distances below this are rounding; the square root of 0 has no derivative.
_NO_DISTANCE = 1e-30


def covariance(rows: Tensor, length_scale: Tensor, output_scale: Tensor) -> Tensor:
    """Covariance of the function among its rows, without noise, `... x n x n`.

    Args:
        rows: `... x n x i` [1].
        length_scale: one an input, `... x i`.
        output_scale: variance of the function, `...`.
    """
    return output_scale[..., None, None] * _correlation(_squared_distances(rows / length_scale.unsqueeze(-2)))


def _squared_distances(rows: Tensor) -> Tensor:
    """rows: `... x n x i`; returns `... x n x n`."""
    own = (rows * rows).sum(-1)
    return own.unsqueeze(-1) + own.unsqueeze(-2) - 2 * (rows @ rows.mT)


def _correlation(squared: Tensor) -> Tensor:
    """Of squared distances in units of the length scales (Rasmussen and Williams 2006, eq. 4.17), any shape."""
    scaled = torch.sqrt(3.0 * squared.clamp_min(_NO_DISTANCE))
    return (1 + scaled) * torch.exp(-scaled)


def _correlation_and_slope(squared: Tensor) -> tuple[Tensor, Tensor]:
    """`_correlation`, and its derivative by the squared distance."""
    scaled = torch.sqrt(3.0 * squared.clamp_min(_NO_DISTANCE))
    decay = torch.exp(-scaled)
    return (1 + scaled) * decay, -1.5 * decay


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


class Evidence(NamedTuple):
    """Of `b` processes side by side.

    Attributes:
        value: log marginal likelihood plus log prior, `b` [nats]; -inf where the covariance has no Cholesky factor.
        slope: its derivative by the hyperparameters, `b x k`.
        dual: covariance⁻¹ · (targets - mean), `b x n`.
        residual: targets minus the mean prediction at the rows themselves, `b x n`; 0 in rows of weight 0.
    """

    value: Tensor
    slope: Tensor
    dual: Tensor
    residual: Tensor


def log_evidence(theta: Tensor, inputs: Tensor, targets: Tensor, weights: Tensor) -> Evidence:
    """Log marginal likelihood (Rasmussen and Williams 2006, eq. 5.8) and its slope (eq. 5.9) by one Cholesky factor.

    With A = dual · dualᵀ - covariance⁻¹ the slope by the covariance is A / 2, and that by a length scale is a product
    of this matrix with the rows.

    Args:
        theta: hyperparameters, `b x k`.
        inputs: `b x n x i` [1].
        targets: `b x n` [1].
        weights: `b x n`: the noise of a row has the variance noise / weight; rows of weight 0 do not exist.
    """
    there = weights > 0
    length_scale, (output_scale, noise, mean) = theta[..., :-3].exp(), theta[..., -3:].unbind(-1)
    signal, free = torch.where(there, output_scale.exp().unsqueeze(-1), 0.0), noise.exp()
    noise = free + NOISE_FLOOR
    noises = torch.where(there, noise.unsqueeze(-1) / torch.where(there, weights, 1.0), 1.0)
    scaled = torch.where(there.unsqueeze(-1), inputs, 0.0) / length_scale.unsqueeze(-2)
    correlation, decline = _correlation_and_slope(_squared_distances(scaled))
    both = signal.unsqueeze(-1) * there.unsqueeze(-2)
    function = correlation.mul_(both)
    covariances = function.clone()
    covariances.diagonal(dim1=-2, dim2=-1).add_(noises)
    factor, info = torch.linalg.cholesky_ex(covariances)
    identity = torch.eye(inputs.shape[1], dtype=inputs.dtype, device=inputs.device)
    factor = torch.where((info == 0)[:, None, None], factor, identity)
    error = torch.where(there, targets - mean.unsqueeze(-1), 0.0)
    dual = torch.cholesky_solve(error.unsqueeze(-1), factor).squeeze(-1)
    half_logdet = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    fit = -0.5 * (error * dual).sum(-1) - half_logdet - 0.5 * math.log(2 * math.pi) * there.to(mean.dtype).sum(-1)
    by_covariance = torch.baddbmm(torch.cholesky_inverse(factor), dual.unsqueeze(-1), dual.unsqueeze(-2), beta=-1.0)
    by_covariance.mul_(0.5)
    by_distance = decline.mul_(both).mul_(by_covariance)
    # Sums of by_distance · (x - x')² over all pairs, input by input.
    apart = scaled * scaled * by_distance.sum(-1, keepdim=True) - scaled * (by_distance @ scaled)
    by_noise = (by_covariance.diagonal(dim1=-2, dim2=-1) * noises * there).sum(-1) * free / noise
    slope = [(by_covariance * function).sum((-2, -1)), by_noise, dual.sum(-1)]
    gradient = torch.cat([-4 * apart.sum(-2), torch.stack(slope, -1)], -1)
    # Of as many numbers as there are hyperparameters: autograd costs nothing here.
    with torch.enable_grad():
        asked = theta.detach().requires_grad_()
        prior = _log_prior(asked, (asked[..., -2].exp() + NOISE_FLOOR).log())
        gradient = gradient + torch.autograd.grad(prior.sum(), asked)[0]
    value = fit + prior.detach()
    good = (info == 0) & value.isfinite() & gradient.isfinite().all(-1)
    return Evidence(
        torch.where(good, value, -torch.inf),
        torch.where(good.unsqueeze(-1), gradient, 0.0),
        torch.where(good.unsqueeze(-1), dual, 0.0),
        torch.where(good.unsqueeze(-1), dual * noises * there, error),
    )


def _log_prior(theta: Tensor, log_noise: Tensor) -> Tensor:
    """theta: `b x k`; log_noise: logarithm of the noise's variance, `b`; returns `b` [nats]."""
    middle, spread = _LENGTH
    middle += math.log(theta.shape[-1] - 3) / 2
    lengths = _log_normal(theta[..., :-3], middle, spread).sum(-1)
    return lengths + _log_normal(theta[..., -3], *_SCALE) + _log_normal(log_noise, *_NOISE)


def _log_normal(value: Tensor, middle: float, spread: float) -> Tensor:
    return -0.5 * ((value - middle) / spread).square() - math.log(spread) - 0.5 * math.log(2 * math.pi)


class GPNetwork(nn.Module):
    """Mean and variance of `o` independent Gaussian processes on shared rows, for one repeat.

    All outputs go through the same few operations, which keeps the graph of a model file small: with squared distances
    as |x / l|² + |row / l|² - 2 x · (row / l²), rows and length scales are needed in three combinations only. Made of
    operations that ONNX Runtime has in double.

    Attributes:
        inverse_squares: 1 / l², `i x o` [1].
        points: row / l², `i x (o n)` [1].
        own: |row / l|², `o x n` [1].
        dual: weights of the rows times the variance of the function, `o x n` [1].
        spread: inverse Cholesky factors of the covariance of the first `v` rows, times the same, `o x v x v` [1].
        output_scale, noise, constant: variance of the function, of the noise, and the mean far from all rows, `o` [1].
    """

    # Thousands of terms of both signs cancel in a prediction, so that engines which sum in another order agree to
    # fewer digits than for a network of some nodes.
    export_tolerance = 1e-9

    inverse_squares: Tensor
    points: Tensor
    own: Tensor
    dual: Tensor
    spread: Tensor
    output_scale: Tensor
    noise: Tensor
    constant: Tensor

    def __init__(
        self,
        rows: Tensor,
        dual: Tensor,
        spread: Tensor,
        length_scale: Tensor,
        output_scale: Tensor,
        noise: Tensor,
        constant: Tensor,
    ) -> None:
        """From one repeat's process.

        Args:
            rows: training rows, `n x i` [1]; the variance knows of the first `v` alone.
            dual: weights of the rows, `o x n` [1].
            spread: inverse Cholesky factors (`spread_factor`) of the first `v` rows' covariances, `o x v x v`.
            length_scale: `o x i` [1].
            output_scale, noise, constant: `o` [1].
        """
        super().__init__()
        inverse = 1 / (length_scale * length_scale)
        points = rows * inverse.unsqueeze(1)
        for name, value in (
            ("inverse_squares", inverse.mT.contiguous()),
            ("points", points.flatten(0, 1).mT.contiguous()),
            ("own", (rows * points).sum(-1)),
            ("dual", dual * output_scale.unsqueeze(-1)),
            ("spread", spread * output_scale[:, None, None]),
            ("output_scale", output_scale.clone()),
            ("noise", noise.clone()),
            ("constant", constant.clone()),
        ):
            self.register_buffer(name, value)

    def forward(self, features: Tensor) -> Tensor:
        """features: `... x i`; returns `... x o`."""
        correlation = self._correlation(features, self.points, self.own)
        return (correlation * self.dual).sum(-1) + self.constant

    def variance(self, features: Tensor) -> Tensor:
        """Variance of a newly measured output, noise included; features: `... x i`; returns `... x o`, above 0.

        An upper bound of that of the process: leaving out rows never lowers a variance.
        """
        known = self.spread.shape[-1]
        points = self.points.reshape(-1, *self.own.shape)[..., :known].flatten(1)
        correlation = self._correlation(features, points, self.own[:, :known])
        # One output at a time: a product of all at once would copy the factors for every row of the features.
        weighted = [correlation[..., k, :] @ factor.mT for k, factor in enumerate(self.spread)]
        explained = torch.stack([(part * part).sum(-1) for part in weighted], -1)
        return (self.output_scale - explained).clamp_min(0.0) + self.noise

    def _correlation(self, features: Tensor, points: Tensor, own: Tensor) -> Tensor:
        """With the rows of `points` and `own`, `... x o x n`."""
        across = (features @ points).reshape(*features.shape[:-1], *own.shape)
        square = ((features * features) @ self.inverse_squares).unsqueeze(-1)
        return _correlation(square + own - 2 * across)

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        inputs, outputs = self.inverse_squares.shape
        return {
            "kind": "gp",
            "kernel": _KERNEL,
            "inputs": inputs,
            "outputs": outputs,
            "rows": self.own.shape[-1],
            "variance_rows": self.spread.shape[-1],
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> GPNetwork:
        """A module of the described shape, for its tensors to be loaded into."""
        if description["kernel"] != _KERNEL:
            raise ModelFileError(f"the model has the kernel {description['kernel']}, which this version does not have")
        i, o, n, v = (int(description[key]) for key in ("inputs", "outputs", "rows", "variance_rows"))
        shapes = ((n, i), (o, n), (o, v, v), (o, i), (o,), (o,), (o,))
        return cls(*(torch.ones(shape, dtype=torch.float64) for shape in shapes))
