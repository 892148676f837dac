"""How sure a network is: the predictive variance of a newly measured output.

Laplace's approximation in the output layer alone (MacKay, "Bayesian interpolation", Neural Computation 4, 1992; in the
last layer of a deep network: Kristiadi, Hein and Hennig, ICML 2020): the hidden layers count as known, so that the
posterior of the output weights is the exact one of a linear model. To it come the noise, from the residuals of the
training rows, and where several networks are averaged, the scatter of their outputs about the mean. All three are
quadratic forms of the last hidden layer, so one matrix per output holds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evolution.genome import kept
from ccnn_torch.evolution.network import forward, hidden_signal
from ccnn_torch.evolution.waves import Waves

_SMALLEST_NOISE = 1e-12
# The mean of an output is not held back by a prior; this only keeps the matrix regular.
_FLAT = 1e-6
# Of its rows' freedom a fit keeps at least this share, however many weights look determined.
_LEAST_FREEDOM = 0.1
# Output weights of about 0 would claim a prior of any precision.
_SMALLEST_WEIGHT = 1e-6


class Spread(NamedTuple):
    """Variance of output o = noise[o] + sum over q of (factors[o, q] . [hidden, 1])².

    Attributes:
        factors: `... x o x q x (h + 1)` [1], h = nodes of the (averaged) network's last hidden layer.
        noise: `... x o` [1].
    """

    factors: Tensor
    noise: Tensor


def readout_spread(
    masks: Sequence[Tensor],
    weights: Sequence[Tensor],
    inputs: Tensor,
    targets: Tensor,
    rows: Tensor,
    waves: Waves | None = None,
) -> Spread:
    """The spread of the mean of `m` networks, from the rows they were trained on.

    Args:
        masks, weights: one a layer, `... x m x out x in` and `... x m x out x (in or in + 1)`; m = 1 for one network.
        inputs: `... x s x i` [1].
        targets: `... x s x o` [1].
        rows: row weights, `... x s`; rows of weight 0 are left out, even with NaN.
        waves: periodic nodes, `... x m x k`.
    """
    there = (rows > 0).unsqueeze(-1)
    inputs, targets = inputs.masked_fill(~there, 0), targets.masked_fill(~there, 0)
    hidden = hidden_signal(masks, weights, inputs.unsqueeze(-3), waves)
    basis = torch.cat([hidden, torch.ones_like(hidden[..., :1])], -1)
    readout, determined = _readout(masks[-1], weights[-1])
    # Averaged over the networks, of each output and each row.
    residual = forward(masks, weights, inputs.unsqueeze(-3), waves).mean(-3) - targets
    squares = (residual.square() * rows.unsqueeze(-1)).sum(-2)
    count = rows.sum(-1, keepdim=True)
    noise = (squares / count).clamp_min(_SMALLEST_NOISE)
    gram = (basis.mT * rows[..., None, None, :]) @ basis
    prior = _prior(readout, determined)
    matrix = _posterior(gram, noise, prior, determined)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(matrix))
    shrunk = (prior * inverse.diagonal(dim1=-2, dim2=-1) * determined).sum(-1)
    known = (determined.sum(-1) - shrunk).mean(-2)
    noise = squares / torch.maximum(count - known, count * _LEAST_FREEDOM)
    noise = noise.clamp_min(_SMALLEST_NOISE)
    root = torch.linalg.cholesky(_posterior(gram, noise, prior, determined))
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    factors = torch.linalg.solve_triangular(root, eye.expand_as(root), upper=False) * determined.unsqueeze(-2)
    slots = 0 if waves is None else waves.frequency.shape[-1]
    return Spread(_combine(factors, readout, len(masks) == 1, slots), noise)


def spread_variance(
    masks: Sequence[Tensor], weights: Sequence[Tensor], spread: Spread, inputs: Tensor, waves: Waves | None = None
) -> Tensor:
    """Predictive variance of every row, `... x s x o` [1].

    Args:
        masks, weights: of the averaged network (`average`), one a layer, `... x out x in`.
        inputs: `... x s x i` [1].
        waves: of the averaged network, `... x k`.
    """
    hidden = hidden_signal(masks, weights, inputs, waves)
    basis = torch.cat([hidden, torch.ones_like(hidden[..., :1])], -1)
    scatter = basis.unsqueeze(-3) @ spread.factors.mT
    return scatter.square().sum(-1).mT + spread.noise.unsqueeze(-2)


def _readout(mask: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Output weights with the bias last, and which of them are there: `... x m x o x (h + 1)` each."""
    width = mask.shape[-1]
    connected = kept(mask, weight)
    bias = connected[..., width:] if weight.shape[-1] > width else torch.zeros_like(connected[..., :1])
    readout = torch.cat([connected[..., :width], bias], -1)
    return readout, torch.cat([mask, torch.ones_like(mask[..., :1])], -1).to(weight.dtype)


def _prior(readout: Tensor, determined: Tensor) -> Tensor:
    """Precision of each output weight: the inverse mean square of the weights of its output."""
    connections = readout[..., :-1]
    count = determined[..., :-1].sum(-1, keepdim=True).clamp_min(1)
    precision = count / connections.square().sum(-1, keepdim=True).clamp_min(_SMALLEST_WEIGHT)
    return torch.cat([precision.expand_as(connections), torch.full_like(precision, _FLAT)], -1)


def _posterior(gram: Tensor, noise: Tensor, prior: Tensor, determined: Tensor) -> Tensor:
    """Precision matrices of the output weights, `... x m x o x (h + 1) x (h + 1)`; 1 for weights that are not there."""
    fitted = gram.unsqueeze(-3) / noise[..., None, :, None, None]
    fitted = fitted * determined.unsqueeze(-1) * determined.unsqueeze(-2)
    return fitted + torch.diag_embed(torch.where(determined > 0, prior, 1.0))


def _combine(factors: Tensor, readout: Tensor, shared: bool, slots: int) -> Tensor:
    """Factors of each network (`... x m x o x q x (h + 1)`) and their scatter, in the averaged network's last layer."""
    members = factors.shape[-4]
    own = _beside(factors / members**0.5, shared, slots).movedim(-4, -3).flatten(-3, -2)
    if members == 1:
        return own
    outputs = _beside(readout.unsqueeze(-2), shared, slots)
    apart = (outputs - outputs.mean(-4, keepdim=True)) / (members - 1) ** 0.5
    return torch.cat([own, apart.movedim(-4, -3).flatten(-3, -2)], -2)


def _beside(factors: Tensor, shared: bool, slots: int) -> Tensor:
    """`... x m x o x q x (h + 1)` to columns of the averaged network: hidden nodes, sines and cosines, each by member.

    `shared`: the members have no hidden layer, so that they all read the same inputs.
    """
    hidden = factors.shape[-1] - 1 - 2 * slots
    parts = torch.split(factors, [hidden, slots, slots, 1], -1)
    wide = [parts[0] if shared else _apart(parts[0]), _apart(parts[1]), _apart(parts[2]), parts[3]]
    return torch.cat(wide, -1)


def _apart(factors: Tensor) -> Tensor:
    """`... x m x o x q x h` to `... x m x o x q x (m h)`, zero in the columns of the other members."""
    members = factors.shape[-4]
    eye = torch.eye(members, dtype=factors.dtype, device=factors.device)
    return (factors.unsqueeze(-2) * eye[:, None, None, :, None]).flatten(-2)
