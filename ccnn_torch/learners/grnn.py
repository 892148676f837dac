"""The general regression neural network (Specht 1991) with bandwidths found by leave-one-out, as a learner."""

from __future__ import annotations

import math

import torch
from pydantic.dataclasses import dataclass
from torch import Tensor

from ccnn_torch.evolution.random import uniform
from ccnn_torch.evolution.settings import STRICT, Count, Some
from ccnn_torch.learners.grnn_network import FARTHEST, GRNNNetwork, KernelMeans, KernelVariance, blocked_means
from ccnn_torch.learners.protocol import TrainingData, weighted_mse
from ccnn_torch.learners.rows import taken, usable_rows

# Streams of random numbers: which rows are judged, and the moves of each step.
_ROWS, _MOVES = 0, 1
# Bandwidths of the first step go from the one to the other, geometrically, besides an infinite one, which is the mean;
# features are in -1 .. 1.
_NARROWEST, _WIDEST = 0.02, 5.0
# Factor by which a bandwidth first moves; its root is taken each time that no move was better.
_FIRST_MOVE = 2.0
# The search has converged once the factor of a move is below this: leave-one-out is flat at its lowest.
_SMALLEST_MOVE = 1.05
# Standard errors by which the best bandwidths must beat the mean of all rows, row by row in leave-one-out, to be used
# at all. The lowest of many errors is low by luck too: with nothing to learn in 100 rows, 0 costs 2 % of the variance
# and 1.5 a tenth of that, while on case one the gain is 3.5 to 6.
_CAUTION = 1.5


@dataclass(frozen=True, config=STRICT)
class GRNNSettings:
    """Settings of the GRNN; the paper gives none of its own.

    Attributes:
        iterations: steps at most. The first judges one bandwidth for all inputs, each further one moves around the
            best so far; 30 suffice for a dozen inputs, and the search ends earlier once its moves are small.
        candidates: bandwidth vectors judged in one step, all in one batch; never fewer than three for each input.
        queries: rows that leave-one-out judges, drawn once by seed where there are more. Bandwidth vectors are
            compared on the same rows, so that 500 distinguish them as well as all would.
        references: rows that they are predicted from, drawn likewise; the bandwidths are then narrowed by
            (references / rows) ** (1 / (4 + inputs)) for the use of all rows, the rate at which the best ones shrink.

    Raises:
        ValueError: a value out of its range, in one sentence with the key.
    """

    iterations: Count = 30
    candidates: Some = 32
    queries: Some = 500
    references: Some = 2000


class GRNN:
    """Kernel regression with one bandwidth per input, shared by the outputs; a step judges a batch of bandwidths.

    The criterion is the mean squared leave-one-out error, in the channels of `data.metric` where there is one; the
    model has the bandwidths of the lowest so far, or is the mean where they are no better by chance. Moves of
    a step: each bandwidth up, down, and switched off or on; and random moves of several at once. Everything is exact
    up to `references` rows, and computed in blocks of a few megabytes beyond.

    Variance: kernel-weighted mean of the squared leave-one-out residuals, which a few rows alone do not determine and
    which is therefore drawn towards their overall mean; times (1 + sum of squared shares) for the error of the mean
    itself; plus the variance that the inputs explain where no row is near.

    Metrics of a step: `error_train` (on the judged rows alone beyond `references`), `error_leave_one_out` (in the
    channels of the metric, the lowest so far), `evaluations` (leave-one-out errors so far), each `r`.
    """

    name = "grnn"

    def __init__(self, settings: GRNNSettings | None = None) -> None:
        self.settings = settings or GRNNSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data; the first model is the mean.

        Raises:
            MethodFailedError: training rows are not finite.
        """
        rows = usable_rows(data)
        self._data, self._seeds = rows, data.seeds
        # Rows in an order drawn by seed, padded ones last, as many as are used; the judged ones (queries) first.
        count = rows.weights.shape[1]
        keys = uniform(self._seeds, _ROWS, 0, (count,)) + (rows.weights == 0)
        self._judged = taken(rows, keys.argsort(-1)[:, : self.settings.references])
        self._own = torch.arange(min(self.settings.queries, self.settings.references, count), device=keys.device)
        repeats, width = len(data.seeds), data.inputs.shape[-1]
        self._inverse = rows.inputs.new_zeros(repeats, width)
        self._move = rows.inputs.new_full((repeats,), _FIRST_MOVE)
        self._of_mean = self._squares(self._inverse.unsqueeze(1))
        self._error = self._mean_of_rows(self._of_mean)[:, 0]
        self._trusted = torch.zeros_like(data.seeds, dtype=torch.bool)
        self._step = torch.zeros((), dtype=torch.int64)

    def step(self) -> dict[str, Tensor]:
        """Judge a batch of bandwidth vectors, keep the best."""
        first = int(self._step) == 0
        proposals = self._grid() if first else self._moves()
        self._step = self._step + 1
        squares = self._squares(proposals)
        error, which = self._mean_of_rows(squares).min(1)
        better = error < self._error
        repeats = torch.arange(len(which), device=which.device)
        self._inverse = torch.where(better.unsqueeze(-1), proposals[repeats, which], self._inverse)
        self._trusted = torch.where(better, self._beats_mean(squares[repeats, which]), self._trusted)
        self._error = torch.where(better, error, self._error)
        if not first:
            self._move = torch.where(better, self._move, self._move.sqrt())
        judged = 1 + self._grid().shape[1] + (int(self._step) - 1) * self._move_count
        return {
            "error_train": self._training_error(),
            "error_leave_one_out": self._error,
            "evaluations": torch.full_like(self._error, judged),
        }

    @property
    def finished(self) -> bool:
        """True once the search has converged in every repeat, or after the last step."""
        return int(self._step) > 0 and (bool(self.converged.all()) or int(self._step) >= self.settings.iterations)

    @property
    def converged(self) -> Tensor:
        """Whether no move of the smallest size was better, `r`, bool."""
        return self._move < _SMALLEST_MOVE

    @property
    def steps(self) -> int:
        """Steps at most."""
        return self.settings.iterations

    def predict(self, inputs: Tensor) -> Tensor:
        """Output of the model of each repeat. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        rows = self._data
        inverse = self._narrowed(self._model()).unsqueeze(1)
        return blocked_means(inputs, rows.inputs, rows.weights.log(), rows.targets, inverse).mean[:, 0]

    def variance(self, inputs: Tensor) -> Tensor:
        """Of a newly measured output. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        bounded = inputs.clamp(-FARTHEST, FARTHEST)
        return torch.stack([self.network(repeat).variance(bounded[repeat]) for repeat in range(len(inputs))])

    def network(self, repeat: int) -> GRNNNetwork:
        """The model of one repeat, with its rows."""
        rows = self._data
        there = rows.weights[repeat] > 0
        return GRNNNetwork(
            rows.inputs[repeat, there],
            rows.targets[repeat, there],
            rows.weights[repeat, there].log(),
            self._narrowed(self._model())[repeat],
            self._residuals(repeat),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Best bandwidths and their leave-one-out error, whether they are used, size of the moves, steps done."""
        return {
            "inverse_bandwidths": self._inverse,
            "trusted": self._trusted,
            "error_leave_one_out": self._error,
            "move": self._move,
            "step": self._step,
        }

    def condition(self, state: dict[str, Tensor]) -> None:
        """Take the bandwidths of a model on other rows, for those of `start`."""
        self.load_state_dict(state)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""
        self._inverse, self._error = state["inverse_bandwidths"], state["error_leave_one_out"]
        self._trusted, self._move, self._step = state["trusted"], state["move"], state["step"]

    @property
    def _move_count(self) -> int:
        return max(self.settings.candidates, 3 * self._inverse.shape[-1])

    def _grid(self) -> Tensor:
        """One bandwidth for all inputs, `r x c x i` (1 / h)."""
        powers = torch.linspace(0, 1, self.settings.candidates, dtype=torch.float64, device=self._inverse.device)
        inverse = (_WIDEST / _NARROWEST) ** powers / _WIDEST
        repeats, width = self._inverse.shape
        return inverse.view(1, -1, 1).expand(repeats, -1, width)

    def _moves(self) -> Tensor:
        """Neighbours of the best bandwidths, `r x c x i` (1 / h)."""
        best = self._inverse.unsqueeze(1)
        width = self._inverse.shape[-1]
        count, structured = self._move_count, 3 * width
        draws = uniform(self._seeds, _MOVES, int(self._step), (2, count, width))
        fresh = torch.exp(math.log(_WIDEST / _NARROWEST) * draws[:, 0]) / _WIDEST
        # Each input alone: narrower, wider, off; where it is off: three fresh bandwidths.
        alone = torch.eye(width, dtype=torch.bool, device=best.device)
        factor = torch.stack([self._move, 1 / self._move, torch.zeros_like(self._move)], -1)
        scale = torch.where(alone, factor[:, :, None, None], 1.0).flatten(1, 2)
        one = torch.where(alone.repeat(3, 1) & (best == 0), fresh[:, :structured], best * scale)
        # Several at once: half of those that are on, each by up to the factor.
        centred = draws[:, 1, structured:] * 4 - 2
        powers = torch.where(centred.abs() < 1, centred, 0.0)
        several = best * self._move.view(-1, 1, 1) ** powers
        return torch.cat([one, several], 1)

    def _model(self) -> Tensor:
        """1 / h of the model before they are narrowed, `r x i`: the best found, or 0 where the mean does as well."""
        return torch.where(self._trusted.unsqueeze(-1), self._inverse, 0.0)

    def _squares(self, inverse: Tensor) -> Tensor:
        """Squared leave-one-out error of every judged row. inverse: `r x c x i`; returns `r x c x q`."""
        judged, count = self._judged, len(self._own)
        means = self._left_out(slice(None), inverse).mean
        error = means - judged.targets[:, None, :count]
        if judged.metric is not None:
            error = (judged.metric[:, None, :count] @ error.unsqueeze(-1)).squeeze(-1)
        return error.square().mean(-1)

    def _left_out(self, repeats: slice, inverse: Tensor) -> KernelMeans:
        """Means at the judged rows without the row itself. inverse: 1 / h, `r x c x i`."""
        judged = self._judged
        rows, count = judged.inputs[repeats], len(self._own)
        logarithms = judged.weights[repeats].log()
        return blocked_means(rows[:, :count], rows, logarithms, judged.targets[repeats], inverse, self._own)

    def _mean_of_rows(self, values: Tensor) -> Tensor:
        """Weighted mean over the judged rows. values: `r x ... x q`; returns `r x ...`."""
        weights = self._judged.weights[:, : len(self._own)]
        shares = weights / weights.sum(-1, keepdim=True)
        return (values * shares.view(len(shares), *[1] * (values.dim() - 2), -1)).sum(-1)

    def _beats_mean(self, squares: Tensor) -> Tensor:
        """Whether squared errors are below those of the mean by more than chance would have it. squares: `r x q`."""
        gain = self._of_mean[:, 0] - squares
        mean = self._mean_of_rows(gain)
        variance = self._mean_of_rows((gain - mean.unsqueeze(-1)).square())
        count = self._judged.weights[:, : len(self._own)].sum(-1)
        return mean > _CAUTION * (variance / count).sqrt()

    def _training_error(self) -> Tensor:
        """Mean squared error of the model on all training rows, or on the judged ones where there are more; `r`."""
        judged, rows = self._judged, self._data
        if rows.weights.shape[1] <= self.settings.references:
            return weighted_mse(self.predict(rows.inputs), rows.targets, rows.weights)
        here = slice(0, len(self._own))
        return weighted_mse(self.predict(judged.inputs[:, here]), judged.targets[:, here], judged.weights[:, here])

    def _narrowed(self, inverse: Tensor) -> Tensor:
        """1 / h for the use of all rows, `r x i`: bandwidths shrink as rows ** (-1 / (4 + inputs that are on))."""
        kept, whole = ((part.weights > 0).to(self._inverse.dtype).sum(-1) for part in (self._judged, self._data))
        inputs = (inverse > 0).sum(-1)
        return inverse / ((kept / whole) ** (1 / (4 + inputs.to(kept.dtype)))).unsqueeze(-1)

    def _residuals(self, repeat: int) -> KernelVariance:
        """What the leave-one-out residuals of one repeat show of the noise."""
        judged = self._judged
        count = len(self._own)
        there = judged.weights[repeat] > 0
        queried = there[:count]
        one = slice(repeat, repeat + 1)
        found = self._left_out(one, self._model()[one].unsqueeze(1))
        residual = (found.mean[0, 0] - judged.targets[repeat, :count])[queried]
        # A residual holds the error of the mean it is taken from as well.
        squares = residual.square() / (1 + found.squares[0, 0, queried].unsqueeze(-1))
        weights = judged.weights[repeat, :count][queried]
        shares = (weights / weights.sum()).unsqueeze(-1)
        targets = judged.targets[repeat, :count][queried]
        whole = ((targets - (targets * shares).sum(0)).square() * shares).sum(0)
        return KernelVariance(judged.inputs[repeat, :count][queried], weights.log(), squares, whole)
