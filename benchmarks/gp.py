"""The Gaussian process beside scikit-learn's and GPyTorch's own loop, one length scale an input, three outputs."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from benchmarks.measure import Row, compare
from benchmarks.training import training_rows
from ccnn_torch.learners import make_learner
from ccnn_torch.training import train

# Steps of Adam that GPyTorch's documentation takes.
STEPS = 50


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Defaults of each, the same kernel."""
    for rows in (30, 60, 120) if quick else (100, 300, 1000):
        data = training_rows(rows)
        x, y = data.inputs[0], data.targets[0]
        peers: dict[str, Any] = {"scikit-learn": partial(scikit, x, y)}
        if find_spec("gpytorch"):
            peers[f"GPyTorch, {STEPS} steps of Adam"] = partial(plain_gpytorch, x, y)
        yield from compare(
            "fit a Gaussian process, 3 outputs",
            rows,
            "rows",
            partial(train, make_learner("gp"), data),
            peers,
            rounds=1,
        )


def scikit(x: torch.Tensor, y: torch.Tensor) -> None:
    """One process an output."""
    kernel = ConstantKernel() * Matern([1.0] * x.shape[-1], nu=1.5) + WhiteKernel(1e-2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for output in y.mT:
            GaussianProcessRegressor(kernel, normalize_y=True).fit(x.numpy(), output.numpy())


def plain_gpytorch(x: torch.Tensor, y: torch.Tensor) -> None:
    """All outputs as a batch."""
    gpytorch: Any = importlib.import_module("gpytorch")

    class Exact(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self, x: torch.Tensor, y: torch.Tensor, likelihood: Any) -> None:
            super().__init__(x, y, likelihood)
            shape = x.shape[:1]
            self.mean_module = gpytorch.means.ConstantMean(batch_shape=shape)
            matern = gpytorch.kernels.MaternKernel(1.5, ard_num_dims=x.shape[-1], batch_shape=shape)
            self.covar_module = gpytorch.kernels.ScaleKernel(matern, batch_shape=shape)

        def forward(self, x: torch.Tensor) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    x = x.expand(y.shape[-1], *x.shape)
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=x.shape[:1])
    model = Exact(x, y.mT, likelihood).double()
    likelihood.double()
    score = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=0.1)
    for _ in range(STEPS):
        optimiser.zero_grad()
        loss = -score(model(x), y.mT).sum()
        loss.backward()
        optimiser.step()
