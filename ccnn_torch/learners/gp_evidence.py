"""Log marginal likelihood of a Gaussian process and its derivatives; kernels, noise, mean and priors are GPyTorch's.

Imported by the learner when a training starts: GPyTorch takes a while to load.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

with warnings.catch_warnings():
    # Its linear algebra package scripts a function at import, by means that torch has deprecated.
    warnings.simplefilter("ignore", DeprecationWarning)
    from gpytorch.constraints import GreaterThan, Positive
    from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
    from gpytorch.likelihoods import GaussianLikelihood
    from gpytorch.means import ConstantMean
    from gpytorch.priors import NormalPrior

# Priors: of length scales the median, in units of the square root of the number of inputs, and the spread of the
# logarithm; of the variances of function and noise the mean and the spread of the logarithm.
_LENGTH, _LENGTH_SPREAD = 4.0, 1.0
_SCALE = (-1.0, 1.5)
_NOISE = (-2.0, 2.0)


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


class GPPrior(nn.Module):
    """Process and noise as functions of a tensor of hyperparameters.

    The hyperparameters of one process are `k = i + 3` numbers: the logarithms of `i` length scales and of the variance
    of the function, the logarithm of (the variance of the noise - `noise_floor`), and the mean.

    Priors, for features in [-1, 1] and standardised targets, are normal in the logarithms, so that the most probable
    value is the median: in the values themselves the density of a wide log-normal peaks far below it, and with short
    length scales sixty rows of noise alone cost 5 % of an output's variance instead of 1 %. Length scales grow with the
    square root of the number of inputs, as distances do (Hvarfner, Hellsten and Nardi, "Vanilla Bayesian Optimization
    Performs Great in High Dimensions", ICML 2024).
    """

    def __init__(self, kernel: str, inputs: int, noise_floor: float) -> None:
        super().__init__()
        logarithm = {"transform": torch.exp, "inv_transform": torch.log}
        one = {"batch_shape": torch.Size([1])}
        shape = {"ard_num_dims": inputs, "lengthscale_constraint": Positive(**logarithm), **one}
        nu = {"matern32": 1.5, "matern52": 2.5}
        base = RBFKernel(**shape) if kernel == "rbf" else MaternKernel(nu=nu[kernel], **shape)
        self.kernel = ScaleKernel(base, outputscale_constraint=Positive(**logarithm), **one)
        self.noise = GaussianLikelihood(noise_constraint=GreaterThan(noise_floor, **logarithm), **one)
        smooth = math.log(_LENGTH) + math.log(inputs) / 2
        base.register_prior("length_prior", _normal(smooth, _LENGTH_SPREAD), lambda module: module.lengthscale.log())
        self.kernel.register_prior("scale_prior", _normal(*_SCALE), lambda module: module.outputscale.log())
        self.noise.register_prior("noise_prior", _normal(*_NOISE), lambda module: module.noise.log())
        self.mean = ConstantMean(batch_shape=torch.Size([1]))
        self.inputs = inputs
        self.double()

    def named(self, theta: Tensor) -> dict[str, Tensor]:
        """theta: `b x k`; returns GPyTorch's parameters by name, each leading with `b`."""
        i = self.inputs
        return {
            "kernel.base_kernel.raw_lengthscale": theta[:, None, :i],
            "kernel.raw_outputscale": theta[:, i],
            "noise.noise_covar.raw_noise": theta[:, i + 1 : i + 2],
            "mean.raw_constant": theta[:, i + 2],
        }

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """inputs: `b x n x i`; returns covariance `b x n x n`, mean `b x n`, noise `b x 1`, log prior `b`."""
        # The priors' closures read the parameters, so they see those of a functional call.
        terms = [
            prior.log_prob(value(module)).reshape(len(inputs), -1).sum(-1)
            for part in (self.kernel, self.noise)
            for _, module, prior, value, _ in part.named_priors()
        ]
        return self.kernel(inputs).to_dense(), self.mean(inputs), self.noise.noise, torch.stack(terms).sum(0)


def _normal(location: float, scale: float) -> NormalPrior:
    """In double from the start: GPyTorch would round plain numbers to single precision."""
    return NormalPrior(*(torch.tensor(number, dtype=torch.float64) for number in (location, scale)))


def log_evidence(process: GPPrior, theta: Tensor, inputs: Tensor, targets: Tensor, weights: Tensor) -> Evidence:
    """Log marginal likelihood (Rasmussen and Williams 2006, eq. 5.8) and its slope (eq. 5.9) by one Cholesky factor.

    The factor is not differentiated: with A = dual · dualᵀ - covariance⁻¹, the slope by the covariance is A / 2, and
    autograd carries it on to the hyperparameters.

    Args:
        theta: `b x k`.
        inputs: `b x n x i` [1].
        targets: `b x n` [1].
        weights: `b x n`: the noise of a row has the variance noise / weight; rows of weight 0 do not exist.
    """
    there = weights > 0
    theta = theta.detach().requires_grad_()
    kernel, mean, noise, prior = functional_call(process, process.named(theta), (inputs,))
    noises = torch.where(there, noise / torch.where(there, weights, 1.0), 1.0)
    both = there.unsqueeze(-1) & there.unsqueeze(-2)
    covariances = torch.where(both, kernel, 0.0) + torch.diag_embed(noises)
    with torch.no_grad():
        factor, info = torch.linalg.cholesky_ex(covariances)
        identity = torch.eye(inputs.shape[1], dtype=inputs.dtype, device=inputs.device)
        factor = torch.where((info == 0)[:, None, None], factor, identity)
        error = torch.where(there, targets - mean, 0.0)
        dual = torch.cholesky_solve(error.unsqueeze(-1), factor).squeeze(-1)
        half_logdet = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        fit = -0.5 * (error * dual).sum(-1) - half_logdet - 0.5 * math.log(2 * math.pi) * there.to(mean.dtype).sum(-1)
        slope = 0.5 * (dual.unsqueeze(-1) * dual.unsqueeze(-2) - torch.cholesky_inverse(factor))
    carried = (slope * covariances).sum() + (dual * mean).sum() + prior.sum()
    (gradient,) = torch.autograd.grad(carried, theta)
    value = fit + prior.detach()
    good = (info == 0) & value.isfinite() & gradient.isfinite().all(-1)
    return Evidence(
        torch.where(good, value, -torch.inf),
        torch.where(good.unsqueeze(-1), gradient, 0.0),
        torch.where(good.unsqueeze(-1), dual, 0.0),
        torch.where(good.unsqueeze(-1), dual * noises.detach() * there, error),
    )
