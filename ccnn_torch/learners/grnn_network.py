"""Kernel sums over stored rows: many bandwidth vectors at once, and the network of one repeat as a plain module.

Nadaraya and Watson (1964), as the general regression neural network of Specht (IEEE Trans. Neural Networks 2, 1991):
the output is the mean of the stored outputs, weighted by exp(-sum_i (x_i - x'_i)^2 / (2 h_i^2)). A bandwidth of
infinity switches an input off; with all of them off the output is the plain mean.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.numerics.blocks import in_blocks
from ccnn_torch.numerics.trees import picked

# Features are about [-1, 1]; further out nothing changes any more, and squares stay finite.
FARTHEST = 1e6
# Doubles of one block. On a CPU 4 MB stay in the cache (measured: twice as fast as 64 MB); an accelerator wants more.
_BLOCK = {"cpu": 1 << 19}
_BLOCK_ELSEWHERE = 1 << 25


class KernelMeans(NamedTuple):
    """Kernel-weighted means at the queries, for every bandwidth vector.

    Attributes:
        mean: `... x c x q x v`.
        squares: sum of the squared shares of the rows, `... x c x q`; 1 / it is how many rows the mean is of.
    """

    mean: Tensor
    squares: Tensor


def block_size(like: Tensor) -> int:
    """Doubles of one block on this device."""
    return _BLOCK.get(like.device.type, _BLOCK_ELSEWHERE)


def kernel_means(
    queries: Tensor,
    rows: Tensor,
    log_weights: Tensor,
    values: Tensor,
    inverse_bandwidths: Tensor,
    own: Tensor | None = None,
) -> KernelMeans:
    """All queries in one piece.

    The largest exponent is taken out before the exponential, so that far from every row the nearest one is left
    instead of 0 / 0.

    Args:
        queries: `... x q x i` [1].
        rows: stored inputs, `... x n x i` [1].
        log_weights: logarithms of their weights, `... x n`; -inf leaves a row out.
        values: what to average, `... x n x v`.
        inverse_bandwidths: 1 / h, `... x c x i`; 0 switches an input off.
        own: number of the row that each query is itself, to be left out, `q` int64; None = no query is a row.
    """
    apart = queries.clamp(-FARTHEST, FARTHEST).transpose(-1, -2).unsqueeze(-1) - rows.transpose(-1, -2).unsqueeze(-2)
    apart = apart * apart
    count, stored = apart.shape[-2], apart.shape[-1]
    precisions = inverse_bandwidths * inverse_bandwidths * -0.5
    exponents = (precisions @ apart.flatten(-2)).reshape(*inverse_bandwidths.shape[:-1], count, stored)
    exponents = exponents + log_weights.unsqueeze(-2).unsqueeze(-3)
    if own is not None:
        itself = own.unsqueeze(-1) == torch.arange(stored, device=own.device)
        exponents = exponents.masked_fill(itself, -torch.inf)
    # The bound is for a query without any row: its kernels are then all 0, and so is its mean.
    nearest = exponents.amax(-1, keepdim=True).clamp_min(-1e300)
    kernels = torch.exp(exponents - nearest)
    shares = kernels / kernels.sum(-1, keepdim=True).clamp_min(1e-300)
    return KernelMeans(shares @ values.unsqueeze(-3), shares.square().sum(-1))


def blocked_means(
    queries: Tensor,
    rows: Tensor,
    log_weights: Tensor,
    values: Tensor,
    inverse_bandwidths: Tensor,
    own: Tensor | None = None,
) -> KernelMeans:
    """`kernel_means` of many repeats, a block of repeats and queries at a time; all leading dimensions are `r`."""
    fixed = (rows, log_weights, values, inverse_bandwidths)

    def of(here: slice, some: slice) -> KernelMeans:
        return kernel_means(queries[here, some], *picked(fixed, here), None if own is None else own[some])

    each = max(1, rows.shape[1] * (rows.shape[2] + 3 * inverse_bandwidths.shape[1]))
    return in_blocks(of, queries.shape[:2], each, block_size(rows), 2)


# Rows' worth of belief in the overall variance: a few squared residuals scatter by a factor of several.
_PRIOR_ROWS = 10.0
_SMALLEST_VARIANCE = 2.0**-40
# Rows that are always one block: a file is written from what is done to an example of fewer.
_ONE_BLOCK = 128


class KernelVariance(NamedTuple):
    """Squared leave-one-out residuals, and what they are compared with.

    Attributes:
        rows: inputs of the judged rows, `m x i` [1].
        log_weights: `m`.
        squares: squared residuals without the error of the mean they are taken from, `m x o` [1].
        whole: variance of the targets, `o` [1].
    """

    rows: Tensor
    log_weights: Tensor
    squares: Tensor
    whole: Tensor


class GRNNNetwork(nn.Module):
    """Kernel sums over stored rows; finite for features up to 1e100.

    It does not bound features itself: a compensator does, and bounded twice (for output and variance) they are exported
    to a graph that cannot be loaded.

    Args:
        rows, targets: `n x i` and `n x o` [1].
        log_weights: logarithms of the rows' weights, `n`.
        inverse_bandwidths: 1 / h, `i`; 0 = the input is switched off.
        residuals: for the variance.
    """

    rows: Tensor
    targets: Tensor
    log_weights: Tensor
    inverse_bandwidths: Tensor
    judged: Tensor
    judged_log_weights: Tensor
    squares: Tensor
    noise: Tensor
    explained: Tensor

    def __init__(
        self,
        rows: Tensor,
        targets: Tensor,
        log_weights: Tensor,
        inverse_bandwidths: Tensor,
        residuals: KernelVariance,
    ) -> None:
        super().__init__()
        shares = torch.softmax(residuals.log_weights, 0)
        noise = (residuals.squares * shares.unsqueeze(-1)).sum(0)
        for name, value in (
            ("rows", rows),
            ("targets", targets),
            ("log_weights", log_weights),
            ("inverse_bandwidths", inverse_bandwidths),
            ("judged", residuals.rows),
            ("judged_log_weights", residuals.log_weights),
            ("squares", residuals.squares),
            ("noise", noise),
            ("explained", (residuals.whole - noise).clamp_min(0)),
        ):
            self.register_buffer(name, value.clone())

    def forward(self, features: Tensor) -> Tensor:
        """features: `... x i` [1]; returns `... x o` [1]."""
        return self._by_blocks(self._output, features)

    def variance(self, features: Tensor) -> Tensor:
        """Variance of a newly measured output. features: `... x i` [1]; returns `... x o` [1]."""
        return self._by_blocks(self._variance, features)

    def _output(self, features: Tensor) -> Tensor:
        kernels, _ = self._kernels(features, self.rows, self.log_weights)
        return kernels @ self.targets / kernels.sum(-1, keepdim=True)

    def _variance(self, features: Tensor) -> Tensor:
        kernels, _ = self._kernels(features, self.judged, self.judged_log_weights)
        total = kernels.sum(-1, keepdim=True)
        count = total * total / (kernels * kernels).sum(-1, keepdim=True)
        noise = (count * (kernels @ self.squares / total) + _PRIOR_ROWS * self.noise) / (count + _PRIOR_ROWS)
        kernels, nearest = self._kernels(features, self.rows, self.log_weights)
        total = kernels.sum(-1, keepdim=True)
        unsure = noise * (1 + (kernels * kernels).sum(-1, keepdim=True) / (total * total))
        backed = (torch.exp(nearest) * total).clamp_max(1.0)
        found = unsure + (1 - backed) * self.explained
        return found.clamp_min(_SMALLEST_VARIANCE)

    def _kernels(self, features: Tensor, rows: Tensor, log_weights: Tensor) -> tuple[Tensor, Tensor]:
        """Kernels of all rows in units of the largest, `... x n`, and its logarithm, `... x 1`."""
        apart = features.unsqueeze(-2) - rows
        exponents = log_weights - (apart * apart) @ (self.inverse_bandwidths * self.inverse_bandwidths / 2)
        nearest = exponents.amax(-1, keepdim=True)
        return torch.exp(exponents - nearest), nearest

    def _by_blocks(self, of: Callable[[Tensor], Tensor], features: Tensor) -> Tensor:
        """Any number of rows in bounded memory."""
        count = max(_ONE_BLOCK, block_size(features) // self.rows.numel())
        if features.shape[:-1].numel() <= count:
            return of(features)
        parts = [of(part) for part in torch.split(features.reshape(-1, features.shape[-1]), count)]
        return torch.cat(parts).reshape(*features.shape[:-1], -1)

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        (rows, inputs), (judged, outputs) = self.rows.shape, self.squares.shape
        return {"kind": "grnn", "rows": rows, "inputs": inputs, "judged": judged, "outputs": outputs}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> GRNNNetwork:
        """An empty module of the described shape, for its tensors to be loaded into."""
        rows, inputs, judged, outputs = (int(description[key]) for key in ("rows", "inputs", "judged", "outputs"))

        def empty(*shape: int) -> Tensor:
            return torch.zeros(*shape, dtype=torch.float64)

        residuals = KernelVariance(empty(judged, inputs), empty(judged), empty(judged, outputs), empty(outputs))
        return cls(empty(rows, inputs), empty(rows, outputs), empty(rows), empty(inputs), residuals)
