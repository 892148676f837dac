"""Exact Gaussian process regression: what a practitioner would try first on a few hundred rows.

All repeats and outputs, each with hyperparameters of its own, go through one call, and the steps are the trainer's,
with its early stopping and its checkpoints. scikit-learn's `fit` is one process at a time, in a loop of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor

from ccnn_torch.evolution.random import uniform
from ccnn_torch.evolution.settings import STRICT, Count, Some
from ccnn_torch.learners.gaussian_process import (
    NOISE_FLOOR,
    Evidence,
    GPNetwork,
    covariance,
    log_evidence,
    spread_factor,
)
from ccnn_torch.learners.protocol import TrainingData
from ccnn_torch.learners.rows import taken, usable_rows
from ccnn_torch.numerics.blocks import block_size

# Numbers in one matrix worked on at a time: what fits into the processor's cache is several times faster than one
# batch of everything.
_CHUNK = 1 << 18
# Matrices of one size that a marginal likelihood and its slope hold at a time.
_COPIES = 12
# Steps between two checks of whether the likelihood still rises.
_LOOK = 5
# First step in the logarithms of the hyperparameters, the smallest slope that it is a share of, and the largest step.
_FIRST_STEP, _FLATTEST, _LARGEST_STEP = 0.1, 1e-4, 1.0
# Share of the rise that the slope promises which a step must bring (Armijo's condition; Nocedal and Wright, "Numerical
# Optimization", 2006, eq. 3.4), and what shortens the next trial where it does not.
_PROMISED, _SHORTER = 1e-4, 0.3
# Logarithms that a search starts from: length scales of the inputs' whole range, a twentieth of the variance noise.
# From a third it ended where some joints of a UR10 are taken for noise (validation error 0.09 instead of 0.06); where
# little can be learned the start makes no difference.
_SMOOTH, _NOISY = 0.7, -3.0
_ORDER_STREAM = 71


@dataclass(frozen=True, config=STRICT)
class GPSettings:
    """Settings of the Gaussian process.

    Attributes:
        steps: steps of the search for the hyperparameters, at most; each costs one marginal likelihood and its slope.
        tolerance: an output's search ends once five steps raised its log marginal likelihood by less than this.
        hyperparameter_rows: training rows, drawn at random where there are more, that the marginal likelihood sees; its
            cost grows with their cube. Predictions before the last step condition on the same rows.
        max_rows: training rows that the final predictions condition on, drawn at random where there are more.
        variance_rows: training rows that predictive variances condition on; fewer than all give an upper bound, and a
            model file holds a matrix of this size for each output.

    Raises:
        ValueError: a value out of its range, in one sentence with the key.
    """

    steps: Count = 100
    tolerance: Annotated[float, Field(ge=0)] = 0.01
    hyperparameter_rows: Some = 600
    max_rows: Some = 3000
    variance_rows: Annotated[int, Field(ge=1, le=512)] = 256


def bfgs(inverse: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """The inverse Hessian after a step (Nocedal and Wright 2006, eq. 6.17), `... x k x k`.

    The first one, a multiple of the identity, is scaled before (eq. 6.20). Without positive curvature along the step
    it stays as it was.

    Args:
        inverse: before, `... x k x k`.
        step: `... x k`.
        change: of the gradient of what is minimised, `... x k`.
    """
    curvature = (step * change).sum(-1)
    usable = curvature > 1e-10 * (change * change).sum(-1)
    scale = torch.where(usable, curvature, 1.0)[..., None, None]
    length = (change * change).sum(-1)[..., None, None]
    identity = torch.eye(step.shape[-1], dtype=step.dtype, device=step.device)
    plain = (inverse - inverse[..., :1, :1] * identity == 0).flatten(-2).all(-1)[..., None, None]
    before = torch.where(plain, identity * scale / length.clamp_min(1e-300), inverse)
    project = identity - step.unsqueeze(-1) * change.unsqueeze(-2) / scale
    after = project @ before @ project.mT + step.unsqueeze(-1) * step.unsqueeze(-2) / scale
    return torch.where(usable[..., None, None], after, inverse)


class GaussianProcess:
    """One process an output, all rows shared; one step is one trial of BFGS up the marginal likelihood.

    Each output has an inverse Hessian of its own (BFGS; Nocedal and Wright 2006, eq. 6.17), a matrix of a few numbers,
    so that it is kept by repeats like everything else. A trial that brings too little is repeated with a shorter step.
    The model has the hyperparameters of the highest marginal likelihood so far (times their prior).

    An output whose covariance has no Cholesky factor falls back to its mean, in that repeat alone, and the repeat then
    does not count as converged.

    Metrics of a step: `log_likelihood` (of the model, summed over outputs, with the prior), `error_train` (mean square
    of the model on the rows of the marginal likelihood, standardised), `evaluations` (marginal likelihoods so far).

    While steps are taken, predictions condition on `hyperparameter_rows` rows; after the last step, and once a state
    was loaded, on `max_rows`. The two differ only where there are more rows than `hyperparameter_rows`.
    """

    name = "gp"

    def __init__(self, settings: GPSettings | None = None) -> None:
        self.settings = settings or GPSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data, draw the rows to work on, and start from wide priors.

        Raises:
            MethodFailedError: a training row is not finite.
        """
        settings, data = self.settings, usable_rows(data)
        r, _, i = data.inputs.shape
        o = data.targets.shape[-1]
        self._shape = r, o
        order = self._order(data)
        rows = taken(data, order)
        self._weights, self._rows, self._targets = rows.weights, rows.inputs, rows.targets.mT.contiguous()
        shares = (data.weights / data.weights.sum(1, keepdim=True)).unsqueeze(-1)
        self._mean = (data.targets * shares).sum(1)
        self._variance = ((data.targets - self._mean.unsqueeze(1)).square() * shares).sum(1)
        self._few = min(settings.hyperparameter_rows, order.shape[1])
        start = self._rows.new_zeros(r, o, i + 3)
        start[..., :i], start[..., i + 1] = _SMOOTH, _NOISY
        empty = start.new_full((r, o), -torch.inf)
        self._accept(
            {
                "theta": start,
                "best_theta": start,
                "slope": torch.zeros_like(start),
                "inverse": torch.zeros_like(start).unsqueeze(-1).repeat(1, 1, 1, i + 3),
                "length": torch.ones_like(empty),
                "best": empty,
                "dual": start.new_zeros(r, o, self._few),
                "error": self._variance,
                "seen": empty,
                "done": torch.zeros(r, o, dtype=torch.bool, device=start.device),
                "settled": torch.zeros(r, o, dtype=torch.bool, device=start.device),
                "evaluations": start.new_zeros(r),
                "step": torch.zeros((), dtype=torch.int64),
            }
        )
        self._stepping = True

    def _order(self, data: TrainingData) -> Tensor:
        """Which rows to use, `r x n`: all in their order where they are few, else drawn by the seeds, padding last."""
        s, device = data.inputs.shape[1], data.inputs.device
        if s <= min(self.settings.hyperparameter_rows, self.settings.variance_rows):
            return torch.arange(s, device=device).expand(len(data.seeds), -1)
        keys = uniform(data.seeds.to(device), _ORDER_STREAM, 0, (s,))
        return torch.where(data.weights > 0, keys, 2.0).argsort(dim=1, stable=True)[:, : self.settings.max_rows]

    def step(self) -> dict[str, Tensor]:
        """One marginal likelihood of every output whose search has not ended, and the next trial of BFGS."""
        state = self._state
        weights = self._weights[:, : self._few]
        going = ~state["done"]
        for rows, outputs in self._chunks(going):
            few = self._rows[rows, : self._few], self._targets[rows, outputs, : self._few], weights[rows]
            found = log_evidence(state["theta"][rows, outputs], *few)
            error = (found.residual.square() * few[2]).sum(-1) / few[2].sum(-1)
            self._climb(rows, outputs, found, error)
        state["evaluations"] += going.any(1)
        state["step"] += 1
        if int(state["step"]) % _LOOK == 0:
            level = going & ~state["done"] & (state["best"] - state["seen"] < self.settings.tolerance)
            state["settled"] |= level
            state["done"] |= level
            state["seen"].copy_(state["best"])
        self._forget()
        self._stepping = not self.finished
        known = torch.where(state["best"] > -torch.inf, state["best"], 0.0)
        return {
            "log_likelihood": known.sum(1),
            "error_train": state["error"].mean(1),
            "evaluations": state["evaluations"].clone(),
        }

    def _climb(self, rows: Tensor, outputs: Tensor, found: Evidence, error: Tensor) -> None:
        """Take the trials that brought enough, `b` of them with their evidence, and set out the next ones."""
        names = ("theta", "best_theta", "best", "slope", "inverse", "length")
        theta, best_theta, best, slope, inverse, length = (self._state[name][rows, outputs] for name in names)
        first, step = best == -torch.inf, theta - best_theta
        taken = found.value > -torch.inf
        taken &= first | (found.value >= best + _PROMISED * (slope * step).sum(-1))
        inverse = torch.where((taken & ~first)[:, None, None], bfgs(inverse, step, slope - found.slope), inverse)
        # So long as nothing is known of the curvature: the steepest way, with a first step of this size.
        steep = _FIRST_STEP / found.slope.abs().amax(-1).clamp_min(_FLATTEST)
        inverse = torch.where((taken & first)[:, None, None], torch.diag_embed(steep.unsqueeze(-1) + 0 * step), inverse)
        slope = torch.where(taken.unsqueeze(-1), found.slope, slope)
        best_theta = torch.where(taken.unsqueeze(-1), theta, best_theta)
        length = torch.where(taken, 1.0, _SHORTER * length)
        way = (inverse @ slope.unsqueeze(-1)).squeeze(-1)
        way = way / (way.abs().amax(-1, keepdim=True) / _LARGEST_STEP).clamp_min(1.0)
        next_theta = best_theta + length.unsqueeze(-1) * way
        values = next_theta, best_theta, torch.where(taken, found.value, best), slope, inverse, length
        for name, value in zip(names, values, strict=True):
            self._state[name][rows, outputs] = value
        for name, value in (("dual", found.dual), ("error", error)):
            take = taken if value.dim() == 1 else taken.unsqueeze(-1)
            self._state[name][rows, outputs] = torch.where(take, value, self._state[name][rows, outputs])
        # There is no way on where the likelihood cannot be evaluated at the start.
        self._state["done"][rows, outputs] |= first & ~taken

    @property
    def finished(self) -> bool:
        """True after the last step, or once no output's likelihood rises any more."""
        return int(self._state["step"]) >= self.settings.steps or bool(self._state["done"].all())

    @property
    def steps(self) -> int:
        """Steps, at most."""
        return self.settings.steps

    @property
    def converged(self) -> Tensor:
        """False where all steps were spent and a likelihood still rose, or an output fell back to its mean, `r`."""
        state = self._state
        fallen = (state["done"] & ~state["settled"]).any(1)
        return ~fallen & (state["settled"].all(1) | (state["evaluations"] < self.settings.steps))

    def predict(self, inputs: Tensor) -> Tensor:
        """Mean of the model of each repeat. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        dual = self._state["dual"] if self._stepping else self._final_dual()
        nothing = dual.new_zeros(*self._shape, 0, 0)
        return self._by_repeat(inputs, dual, nothing, GPNetwork.forward)

    def variance(self, inputs: Tensor) -> Tensor:
        """Variance of a newly measured output, noise included; inputs: `r x s x i` [1]; returns `r x s x o` [1].

        It conditions on `variance_rows` rows, hence is an upper bound of that of the process.
        """
        spread = self._spread()
        return self._by_repeat(inputs, spread.new_zeros(spread.shape[:-1]), spread, GPNetwork.variance)

    def network(self, repeat: int) -> GPNetwork:
        """The model of one repeat, conditioned on `max_rows` rows."""
        return self._network(repeat, self._final_dual(), self._spread())

    def state_dict(self) -> dict[str, Tensor]:
        """Hyperparameters at this point of the search, with BFGS's memory, and those of the model: `r x o x k`."""
        return {name: value.detach().clone() for name, value in self._state.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""
        self._accept(state)
        self._stepping = False

    def condition(self, state: dict[str, Tensor]) -> None:
        """Take the hyperparameters of a model on other rows, and condition on those of `start`."""
        self.load_state_dict(state)
        # Fewer than any, so that the weights of the rows of the search are not taken.
        self._few = 0

    def _accept(self, state: dict[str, Tensor]) -> None:
        # Steps write in place, and what was given stays as it is.
        self._state = {name: value.clone() for name, value in state.items()}
        self._forget()

    def _forget(self) -> None:
        """What follows from the model is worked out again when it is asked for."""
        self._dual_of_all: Tensor | None = None
        self._factors: Tensor | None = None

    def _chunks(self, going: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Indices of repeats and outputs whose search has not ended, a few at a time."""
        size = max(1, min(_CHUNK, block_size(_COPIES * 8)) // self._few**2)
        for part in torch.split(torch.nonzero(going), size):
            yield part[:, 0], part[:, 1]

    def _model(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Length scales `r x o x i`, variances of function and noise and the mean, `r x o` each, of the model."""
        theta, known = self._state["best_theta"], self._state["best"] > -torch.inf
        length_scale, (output_scale, noise, constant) = theta[..., :-3].exp(), theta[..., -3:].unbind(-1)
        return (
            length_scale,
            torch.where(known, output_scale.exp(), 0.0),
            torch.where(known, noise.exp() + NOISE_FLOOR, self._variance + NOISE_FLOOR),
            torch.where(known, constant, self._mean),
        )

    def _network(self, repeat: int, dual: Tensor, spread: Tensor) -> GPNetwork:
        rows = self._rows[repeat, : dual.shape[-1]]
        parts = (dual, spread, *self._model())
        return GPNetwork(rows, *(part[repeat] for part in parts))

    def _by_repeat(
        self, inputs: Tensor, dual: Tensor, spread: Tensor, ask: Callable[[GPNetwork, Tensor], Tensor]
    ) -> Tensor:
        """Ask the network of every repeat; one at a time and in pieces, since they share no matrix."""
        size = max(1, min(_CHUNK, block_size(_COPIES * 8)) // (self._shape[1] * dual.shape[-1]))
        found = []
        for repeat, points in enumerate(inputs):
            network = self._network(repeat, dual, spread)
            found.append(torch.cat([ask(network, part) for part in torch.split(points, size)]))
        return torch.stack(found)

    def _final_dual(self) -> Tensor:
        """Weights of all rows that predictions condition on, `r x o x n`."""
        if self._dual_of_all is None:
            dual = self._state["dual"]
            if self._rows.shape[1] > self._few:
                dual = self._over_outputs(self._rows.shape[1], self._condition)
            self._dual_of_all = dual
        return self._dual_of_all

    def _spread(self) -> Tensor:
        """Inverse Cholesky factors of the rows that variances condition on, `r x o x v x v`."""
        if self._factors is None:
            rows = min(self.settings.variance_rows, self._rows.shape[1])
            # Rows that do not exist carry no information.
            there = self._weights[:, :rows] > 0
            self._factors = self._over_outputs(rows, lambda repeat, _, matrix: spread_factor(matrix) * there[repeat])
        return self._factors

    def _over_outputs(self, rows: int, make: Callable[[int, int, Tensor], Tensor]) -> Tensor:
        """`make` from the covariance of the first rows, noise included, for every repeat and output, `r x o x ...`.

        One matrix at a time: with 3000 rows each takes 72 MB.
        """
        length_scale, output_scale, noise, _ = self._model()
        r, o = self._shape
        inputs, weights = self._rows[:, :rows], self._weights[:, :rows]
        there = weights > 0
        found = []
        for repeat in range(r):
            both = there[repeat].unsqueeze(-1) & there[repeat]
            for output in range(o):
                scales = length_scale[repeat, output], output_scale[repeat, output]
                kernel = covariance(inputs[repeat], *scales)
                noises = torch.where(there[repeat], noise[repeat, output] / weights[repeat], 1.0)
                found.append(make(repeat, output, torch.where(both, kernel, 0.0) + torch.diag(noises)))
        return torch.stack(found).reshape(r, o, *found[0].shape)

    def _condition(self, repeat: int, output: int, covariances: Tensor) -> Tensor:
        """Weights of all rows, `n`; those of the few where the large matrix has no Cholesky factor."""
        there = self._weights[repeat] > 0
        constant = self._model()[3][repeat, output]
        factor, info = torch.linalg.cholesky_ex(covariances)
        few = self._state["dual"][repeat, output]
        if int(info) != 0 or not bool(self._state["best"][repeat, output] > -torch.inf):
            return torch.cat([few, few.new_zeros(len(there) - len(few))])
        error = torch.where(there, self._targets[repeat, output] - constant, 0.0)
        return torch.cholesky_solve(error.unsqueeze(-1), factor).squeeze(-1)
