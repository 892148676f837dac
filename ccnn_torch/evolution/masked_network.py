"""One pruned network as a plain module for export: dense layers, periodic nodes, predictive variance.

Laplace's approximation in the output layer alone (MacKay, "Bayesian interpolation", Neural Computation 4, 1992; in the
last layer of a deep network: Kristiadi, Hein and Hennig, ICML 2020): the hidden layers count as known, so that the
posterior of the output weights is the exact one of a linear model. To it come the noise, from the residuals of the
training rows, and where several networks are averaged, the scatter of their outputs about the mean. All three are
quadratic forms of the last hidden layer, so one matrix per output holds them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from ccnn_torch.evolution.genome import kept
from ccnn_torch.evolution.network import forward, hidden_signal, prune, with_slots
from ccnn_torch.evolution.waves import Harmonics, Waves

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
        masks, weights: of the averaged network (`averaged`), one a layer, `... x out x in`.
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


class MaskedNetwork(nn.Module):
    """A pruned network as dense double-precision linear layers with sigmoids between, ready for export.

    Harmonics of turning joints, where there are any, are added to its output.

    Args:
        masks, weights: one a layer, `out x in` and `out x (in or in + 1)`; missing connections become zeros.
        factors, noise: its predictive variance (`evolution.spread.Spread`), `o x q x (h + 1)` and `o`; 1 without them.
        waves: periodic nodes (`evolution.waves`), `k`, whose columns are last in the output's mask and weights.
        inputs: features in all, where the first layer reads but the leading ones; None = those that it reads.
        harmonics: of one repeat (`evolution.harmonics`), or None.
    """

    factors: Tensor
    noise: Tensor
    frequencies: Tensor
    _sums: Tensor

    def __init__(
        self,
        masks: Sequence[Tensor],
        weights: Sequence[Tensor],
        factors: Tensor | None = None,
        noise: Tensor | None = None,
        waves: Waves | None = None,
        inputs: int | None = None,
        harmonics: Harmonics | None = None,
    ) -> None:
        super().__init__()
        slots = 0 if waves is None else len(waves.frequency)
        read = masks[0].shape[-1] - (2 * slots if len(masks) == 1 else 0)
        unread = 0 if inputs is None else inputs - read
        outputs = len(masks[-1])
        if factors is not None:
            # Rows of the output layer like its weights, they lose the same columns.
            rows = factors.flatten(0, 1)
            own = nn.functional.pad(weights[-1], (0, rows.shape[-1] - weights[-1].shape[-1]))
            masks = [*masks[:-1], torch.cat([masks[-1], masks[-1].any(0).expand(len(rows), -1)])]
            weights = [*weights[:-1], torch.cat([own, rows])]
        small_masks, small_weights = prune(masks, weights)
        # Slots that no output reads take no part.
        used = _used_slots(small_masks[-1], slots)
        hidden = small_masks[-1].shape[-1] - 2 * slots
        small_weights[-1] = with_slots(small_weights[-1], hidden, slots, lambda columns: columns[..., used])
        small_weights[0] = _padded(small_weights[0], read, unread)
        small_weights[-1], rows = small_weights[-1].tensor_split([outputs])
        widths = [read + unread, *(len(mask) for mask in small_masks[:-1])]
        widths[-1] += 2 * int(used.sum())
        layers = [_linear(weight, width) for weight, width in zip(small_weights, widths, strict=True)]
        self.layers = nn.ModuleList(layers)
        noise = layers[-1].weight.new_ones(outputs) if noise is None else noise
        factors = rows.reshape(outputs, len(rows) // outputs, layers[-1].in_features + 1)
        # The same sum of squares in as few terms as the rank; a described network's are zeros, and few.
        if factors.shape[-2] > factors.shape[-1] and bool(factors.any()):
            _, sizes, axes = torch.linalg.svd(torch.linalg.qr(factors, mode="r")[1])
            rounding = sizes.shape[-1] * torch.finfo(sizes.dtype).eps * sizes[..., :1]
            rank = int((sizes > rounding).sum(-1).max())
            factors = (sizes.unsqueeze(-1) * axes)[..., :rank, :]
        self.register_buffer("factors", factors.flatten(0, 1).contiguous())
        self.register_buffer("noise", noise.clone())
        frequencies = layers[0].weight.new_zeros(int(used.sum()), read + unread)
        if waves is not None:
            frequencies.scatter_(1, waves.source[used].unsqueeze(-1), waves.frequency[used].unsqueeze(-1))
        self.register_buffer("frequencies", frequencies)
        # A sum over q as a product: engines with a narrow operator list have no other reduction.
        each = torch.eye(outputs, dtype=factors.dtype, device=factors.device)
        self.register_buffer("_sums", each.repeat_interleave(factors.shape[1], 0), persistent=False)
        self.harmonics = harmonics

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        layers = cast("list[nn.Linear]", list(self.layers))
        sizes = [self.frequencies.shape[-1], *(layer.out_features for layer in layers)]
        described = {
            "kind": "masked",
            "sizes": sizes,
            "spread": len(self.factors) // sizes[-1],
            "waves": len(self.frequencies),
        }
        if self.harmonics is not None:
            described["harmonics"] = list(self.harmonics.factors.shape)
        return described

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> MaskedNetwork:
        """A module of the described shape, for its tensors to be loaded into."""
        sizes = [int(size) for size in description["sizes"]]
        slots, spread = int(description["waves"]), int(description["spread"])
        widths = [*sizes[:-2], sizes[-2] + 2 * slots]
        masks = [torch.ones(out, width, dtype=torch.bool) for out, width in zip(sizes[1:], widths, strict=True)]
        weights = [mask.new_zeros(len(mask), mask.shape[-1] + 1, dtype=torch.float64) for mask in masks]
        frequency = torch.zeros(slots, dtype=torch.float64)
        return cls(
            masks,
            weights,
            torch.zeros(sizes[-1], spread, widths[-1] + 1, dtype=torch.float64) if spread else None,
            torch.ones(sizes[-1], dtype=torch.float64),
            Waves(torch.zeros_like(frequency, dtype=torch.int64), frequency),
            harmonics=_blank_harmonics(description.get("harmonics"), sizes[-1]),
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """inputs: `... x i` [1]; returns `... x o` [1]."""
        output: Tensor = self.layers[-1](self._hidden(inputs))
        return output if self.harmonics is None else output + self.harmonics(inputs)

    def variance(self, inputs: Tensor) -> Tensor:
        """Predictive variance of a newly measured output. inputs: `... x i` [1]; returns `... x o` [1]."""
        if len(self.factors) == 0:
            variance = self.noise.expand(*inputs.shape[:-1], len(self.noise))
        else:
            scatter = self._hidden(inputs) @ self.factors[:, :-1].mT + self.factors[:, -1]
            variance = (scatter * scatter) @ self._sums + self.noise
        return variance if self.harmonics is None else variance + self.harmonics.variance(inputs)

    def _hidden(self, inputs: Tensor) -> Tensor:
        signal = inputs
        for layer in self.layers[:-1]:
            signal = torch.sigmoid(layer(signal))
        if len(self.frequencies) == 0:
            return signal
        phase = inputs @ self.frequencies.mT
        return torch.cat([signal, torch.sin(phase), torch.cos(phase)], -1)


def _blank_harmonics(shape: Sequence[int] | None, outputs: int) -> Harmonics | None:
    """Harmonics of a shape (joints, amplitudes, factors), for tensors to be loaded into."""
    if shape is None:
        return None
    joints, amplitudes, _ = shape
    zeros = torch.zeros(joints, amplitudes, dtype=torch.float64)
    return Harmonics(zeros[:, 0], zeros, zeros.new_zeros(*shape), zeros.new_zeros(joints, outputs))


class _Sparse(nn.Linear):
    """A layer whose connections of weight 0 are none, and stay so when the network is trained on."""

    def reset_parameters(self) -> None:
        """Draw no start values: they would come from the global random state."""

    def forward(self, inputs: Tensor) -> Tensor:
        """`... x i` -> `... x o`."""
        weight = self.weight
        if weight.requires_grad and torch.is_grad_enabled():
            weight = weight * (weight != 0)
        return nn.functional.linear(inputs, weight, self.bias)


def _linear(weight: Tensor, width: int) -> nn.Linear:
    linear = _Sparse(width, len(weight), dtype=torch.float64, device=weight.device)
    linear.requires_grad_(False)
    linear.weight.copy_(weight[:, :width])
    linear.bias.copy_(weight[:, width] if weight.shape[-1] > width else torch.zeros_like(weight[:, 0]))
    return linear


def _used_slots(mask: Tensor, slots: int) -> Tensor:
    """Slots whose sine or cosine some output reads, `k` bool. mask: of the output, its waves last."""
    if slots == 0:
        return mask.new_zeros(0)
    waves = mask[:, mask.shape[-1] - 2 * slots :].any(0)
    return waves[:slots] | waves[slots:]


def _padded(weight: Tensor, read: int, unread: int) -> Tensor:
    """Columns of zeros for features that the layer does not read."""
    return torch.cat([weight[:, :read], weight.new_zeros(len(weight), unread), weight[:, read:]], -1)
