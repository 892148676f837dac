"""One pruned network as a plain module for export: dense layers, periodic nodes, predictive variance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from ccnn_torch.evolution.harmonics import Harmonics
from ccnn_torch.evolution.network import alive_nodes, prune
from ccnn_torch.evolution.waves import Waves


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
        small_masks, small_weights = prune(masks, weights)
        # Slots that no output reads take no part.
        used = _used_slots(small_masks[-1], slots)
        last = _kept_columns(small_weights[-1], small_masks[-1].shape[-1] - 2 * slots, used)
        small_weights = [*small_weights[:-1], last]
        small_weights[0] = _padded(small_weights[0], read, unread)
        widths = [read + unread, *(len(mask) for mask in small_masks[:-1])]
        widths[-1] += 2 * int(used.sum())
        layers = [_linear(weight, width) for weight, width in zip(small_weights, widths, strict=True)]
        self.layers = nn.ModuleList(layers)
        outputs = layers[-1].out_features
        if factors is None or noise is None:
            factors = layers[-1].weight.new_zeros(outputs, 0, layers[-1].in_features + 1)
            noise = layers[-1].weight.new_ones(outputs)
        else:
            factors = _kept_factors(masks, factors, slots, used, read, unread)
            # The same sum of squares in as few terms as there are columns; a described network's are zeros, and few.
            if factors.shape[-2] > factors.shape[-1] and bool(factors.any()):
                factors = torch.linalg.qr(factors, mode="r")[1]
        self.register_buffer("factors", factors.flatten(0, 1).contiguous())
        self.register_buffer("noise", noise.clone())
        frequencies = layers[0].weight.new_zeros(int(used.sum()), read + unread)
        if waves is not None:
            frequencies.scatter_(1, waves.source[used].unsqueeze(-1), waves.frequency[used].unsqueeze(-1))
        self.register_buffer("frequencies", frequencies)
        # A sum over q as a product: engines with a narrow operator list have no other reduction.
        each = torch.eye(outputs, dtype=factors.dtype, device=factors.device)
        self.register_buffer("_sums", each.repeat_interleave(factors.shape[1], 0), persistent=False)
        self.harmonics = None if harmonics is None else HarmonicSum(harmonics)

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


class HarmonicSum(nn.Module):
    """Harmonics of turning joints as a module: the same sums, from buffers that a model file holds."""

    step: Tensor
    amplitude: Tensor
    factors: Tensor
    owner: Tensor

    def __init__(self, harmonics: Harmonics) -> None:
        super().__init__()
        for name, values in vars(harmonics).items():
            self.register_buffer(name, values.clone())

    def forward(self, inputs: Tensor) -> Tensor:
        """inputs: `... x i` [1]; returns `... x o` [1]."""
        return self._plain().deviation(inputs)

    def variance(self, inputs: Tensor) -> Tensor:
        """inputs: `... x i` [1]; returns `... x o` [1]."""
        return self._plain().variance(inputs)

    def _plain(self) -> Harmonics:
        return Harmonics(self.step, self.amplitude, self.factors, self.owner)


def _blank_harmonics(shape: Sequence[int] | None, outputs: int) -> Harmonics | None:
    """Harmonics of a shape (joints, amplitudes, factors), for tensors to be loaded into."""
    if shape is None:
        return None
    joints, amplitudes, _ = shape
    zeros = torch.zeros(joints, amplitudes, dtype=torch.float64)
    return Harmonics(zeros[:, 0], zeros, zeros.new_zeros(*shape), zeros.new_zeros(joints, outputs))


class _Sparse(nn.Linear):
    """A layer whose connections of weight 0 are none, and stay so when the network is trained on."""

    def forward(self, inputs: Tensor) -> Tensor:
        """`... x i` -> `... x o`."""
        weight = self.weight
        if weight.requires_grad and torch.is_grad_enabled():
            weight = weight * (weight != 0)
        return nn.functional.linear(inputs, weight, self.bias)


def _linear(weight: Tensor, width: int) -> nn.Linear:
    # Without its usual start values: those would be drawn from the global random state.
    with torch.device("meta"):
        linear = _Sparse(width, len(weight), dtype=torch.float64)
    linear.to_empty(device=weight.device)
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


def _kept_columns(values: Tensor, hidden: int, used: Tensor) -> Tensor:
    """Columns of the hidden nodes, of the slots in use, and the columns after them."""
    slots = len(used)
    sines, cosines = values[..., hidden : hidden + slots], values[..., hidden + slots : hidden + 2 * slots]
    return torch.cat(
        [values[..., :hidden], sines[..., used], cosines[..., used], values[..., hidden + 2 * slots :]], -1
    )


def _padded(weight: Tensor, read: int, unread: int) -> Tensor:
    """Columns of zeros for features that the layer does not read."""
    return torch.cat([weight[:, :read], weight.new_zeros(len(weight), unread), weight[:, read:]], -1)


def _kept_factors(masks: Sequence[Tensor], factors: Tensor, slots: int, used: Tensor, read: int, unread: int) -> Tensor:
    """Factors `o x q x (h + 1)` with the columns that the pruned network has."""
    hidden = factors.shape[-1] - 1 - 2 * slots
    factors = _kept_columns(factors, hidden, used)
    alive = alive_nodes(masks)
    if not alive:
        zeros = factors.new_zeros(*factors.shape[:-1], unread)
        return torch.cat([factors[..., :read], zeros, factors[..., read:]], -1)
    if not bool(alive[0].any()):
        # One layer without connections to the inputs is left; what a constant is unsure of is its value.
        zeros = factors.new_zeros(*factors.shape[:-1], read + unread)
        return torch.cat([zeros, factors[..., hidden:]], -1)
    return torch.cat([factors[..., :hidden][..., alive[-1]], factors[..., hidden:]], -1)
