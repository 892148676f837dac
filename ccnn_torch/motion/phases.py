"""Phases of a motion: standstill, reversal, fast, and the rest."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.motion.stretches import Stretches

PHASES = ("standstill", "reversal", "fast", "slow")
# Shares of nearly the largest speed.
_STILL, _FAST = 0.03, 0.5
# Seconds before and after a change of direction.
_AROUND = 0.15


def phases_of(data: Stretches) -> Tensor:
    """Phase of each sample of each joint by its measured speed, an index of `PHASES`, `n x b x s`."""
    found = torch.full(data.speed.shape, PHASES.index("slow"))
    step = data.time.diff(dim=-1).median()
    width = 2 * int(_AROUND / step) + 1
    for i, speed in enumerate(data.speed):
        most = float(torch.quantile(speed[data.judged].abs()[:100_000], 0.98))
        moving = speed.abs() > _STILL * most
        sign = torch.sign(speed) * moving
        # The last direction in which it moved, so that a stop between two directions is a reversal too.
        place = torch.arange(sign.shape[-1]).expand(sign.shape)
        last = sign.gather(-1, torch.where(sign != 0, place, 0).cummax(-1).values)
        turned = torch.zeros_like(last)
        turned[..., 1:] = (last[..., 1:] * last[..., :-1] < 0).double()
        near = torch.nn.functional.max_pool1d(turned[:, None], width, 1, width // 2)[:, 0] > 0
        found[i][speed.abs() > _FAST * most] = PHASES.index("fast")
        found[i][near] = PHASES.index("reversal")
        found[i][~moving & ~near] = PHASES.index("standstill")
    return found
