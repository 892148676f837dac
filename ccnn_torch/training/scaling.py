"""From SI inputs to features in [-1, 1], and from standardised outputs back to SI."""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Share of the largest deviation of the outputs below which one is rounding.
_ROUNDING = 1e-9


class Scaling(nn.Module):
    """Input and output scaling of `r` repeats (or of none: every buffer then lacks the leading dimension).

    A linear input x becomes (x - centre) / half_range; a periodic one (a revolute joint that turns far) becomes the
    two features sin x and cos x, so that a full turn is no jump. Features have the order: linear inputs, then the
    sines, then the cosines of the periodic ones, and then, for a learner that reads angles, the periodic ones scaled as
    the linear ones are.

    Attributes:
        linear, periodic: indices of the inputs of either kind, int64.
        centre, half_range: `[r x] len(linear)` [the input's SI unit]; for a learner that reads angles those of the
            periodic inputs behind them.
        mean, deviation: `[r x] o` [the output's SI unit].
    """

    linear: Tensor
    periodic: Tensor
    centre: Tensor
    half_range: Tensor
    mean: Tensor
    deviation: Tensor

    def __init__(
        self, linear: Tensor, periodic: Tensor, centre: Tensor, half_range: Tensor, mean: Tensor, deviation: Tensor
    ) -> None:
        super().__init__()
        self.register_buffer("linear", linear)
        self.register_buffer("periodic", periodic)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half_range)
        self.register_buffer("mean", mean)
        self.register_buffer("deviation", deviation)

    @classmethod
    def fit(cls, inputs: Tensor, targets: Tensor, weights: Tensor, periodic: Tensor, angles: bool = False) -> Scaling:
        """Fit to training rows.

        Args:
            inputs: `r x s x i` [SI].
            targets: `r x s x o` [SI].
            weights: `r x s` [1]; rows of weight 0 are ignored.
            periodic: `i`, bool, which inputs are angles to be fed as sine and cosine.
            angles: whether the learner reads these angles themselves as well.
        """
        there = (weights > 0).unsqueeze(-1)
        linear = torch.nonzero(~periodic).squeeze(-1)
        turning = torch.nonzero(periodic).squeeze(-1)
        values = inputs[..., torch.cat([linear, turning]) if angles else linear]
        low = values.masked_fill(~there, torch.inf).amin(-2)
        high = values.masked_fill(~there, -torch.inf).amax(-2)
        half = (high - low) / 2
        total = weights.sum(-1, keepdim=True)
        mean = (targets * weights.unsqueeze(-1)).sum(-2) / total
        variance = ((targets - mean.unsqueeze(-2)).square() * weights.unsqueeze(-1)).sum(-2) / total
        deviation = variance.sqrt()
        # A constant output keeps scale 1: its standardised value is then 0 and is learned as such. What varies by
        # rounding alone beside the others is as good as constant: standardised, it would outweigh them.
        varies = deviation > _ROUNDING * deviation.amax(-1, keepdim=True)
        return cls(
            linear,
            turning,
            (high + low) / 2,
            torch.where(half > 0, half, torch.ones_like(half)),
            mean,
            torch.where(varies, deviation, torch.ones_like(deviation)),
        )

    @property
    def angle_count(self) -> int:
        """Number of features, the last ones, that are scaled angles."""
        return self.centre.shape[-1] - len(self.linear)

    @property
    def angle_step(self) -> Tensor:
        """Size of these features, `[r x] angle_count` [rad]."""
        return self.half_range[..., len(self.linear) :]

    def repeat(self, index: int) -> Scaling:
        """The scaling of one repeat, without the leading dimension."""
        return Scaling(
            self.linear.clone(),
            self.periodic.clone(),
            *(b[index].clone() for b in (self.centre, self.half_range, self.mean, self.deviation)),
        )

    def of_inputs(self, inputs: Tensor) -> Scaling:
        """The scaling of one repeat with other inputs, `s x i` [SI], all of them linear; outputs as they are."""
        blank = torch.zeros(inputs.shape[-1], dtype=torch.bool)
        new = Scaling.fit(inputs, torch.zeros_like(inputs[:, :1]), torch.ones_like(inputs[:, 0]), blank)
        about = (new.linear, new.periodic, new.centre, new.half_range)
        return Scaling(*about, self.mean.clone(), self.deviation.clone())

    def features(self, inputs: Tensor) -> Tensor:
        """inputs: `[r x] ... x i` [SI]; returns `[r x] ... x f` [1]."""
        # Without a periodic input nothing is picked: exported graphs stay free of gather.
        if len(self.periodic) == 0:
            return self._scaled(inputs, slice(None))
        count = len(self.linear)
        angles = inputs[..., self.periodic]
        parts = [self._scaled(inputs[..., self.linear], slice(None, count)), torch.sin(angles), torch.cos(angles)]
        if self.angle_count:
            parts.append(self._scaled(angles, slice(count, None)))
        return torch.cat(parts, dim=-1)

    def _scaled(self, values: Tensor, which: slice) -> Tensor:
        return (values - _align(self.centre[..., which], values)) / _align(self.half_range[..., which], values)

    def standardise(self, targets: Tensor) -> Tensor:
        """targets: `[r x] ... x o` [SI]; returns the same shape [1]."""
        return (targets - _align(self.mean, targets)) / _align(self.deviation, targets)

    def restore(self, outputs: Tensor) -> Tensor:
        """Inverse of `standardise`."""
        return outputs * _align(self.deviation, outputs) + _align(self.mean, outputs)


def _align(buffer: Tensor, like: Tensor) -> Tensor:
    """View a buffer `[r x] k` so that it broadcasts against `[r x] ... x k`."""
    missing = like.dim() - buffer.dim()
    if buffer.dim() == 1 or missing <= 0:
        return buffer
    return buffer.view(buffer.shape[0], *([1] * missing), buffer.shape[-1])
