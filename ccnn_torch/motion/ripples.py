"""How often in a turn something repeats with the position: where a fit of a wave may begin."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ccnn_torch.motion.stretches import direction

# Periods in a turn up to which waves are looked for, and how many of them are tried.
_HIGHEST, _MOST = 200.0, 4
# Median sizes at which what is left beside smooth functions is clipped.
_CLIPPED = 3.0


def torque_ripples(
    position: Tensor, command: Tensor, time: Tensor, judged: Tensor, nominal: Mapping[str, float]
) -> tuple[float, ...]:
    """Periods in a turn (in 2 pi m) that repeat most in the torque which the nominal model lacks.

    Args:
        position, command, time: `b x s` each.
        judged: samples that count, `b x s`.
        nominal: parameters of the axis.
    """
    step = time.diff(dim=-1)
    rates = [one.diff(dim=-1) / step for one in (position, command)]
    speed, wanted = (0.5 * (one[:, 1:] + one[:, :-1]) for one in rates)
    faster, forced = (one.diff(dim=-1) / (0.5 * (step[:, 1:] + step[:, :-1])) for one in rates)
    here = judged[:, 1:-1] & judged[:, 2:]
    q, u, v, a, w, f = (x[here] for x in (position[:, 1:-1], command[:, 1:-1], speed, faster, wanted, forced))
    motor = u - q + nominal.get("derivative", 0.0) * (nominal.get("forward", 1.0) * w - v)
    torque = nominal.get("inertia", 0.0) * a + nominal.get("viscous", 0.0) * v - motor
    # Of a model without inertia and friction command and position are all of the torque.
    gain = [u] if nominal.get("inertia") or nominal.get("viscous") else []
    return _repeated(torque, q, [*gain, w, direction(w, w.abs().mean()), f])


def left_ripples(left: Tensor, position: Tensor, speed: Tensor) -> tuple[float, ...]:
    """The same of what a model leaves of the position; all of samples that count, `v`."""
    return _repeated(left, position, [speed, direction(speed, speed.abs().mean())])


def _repeated(values: Tensor, q: Tensor, beside: list[Tensor]) -> tuple[float, ...]:
    """Periods that repeat most in values beside smooth functions of the position `q` and other columns."""
    span = float(q.max() - q.min()) or 1.0
    x = (q - q.mean()) / span
    smooth = torch.stack([torch.ones_like(x), *(x**k for k in range(1, 6)), *beside], -1)
    scale = smooth.square().mean(0).sqrt().clamp_min(1e-300)
    smooth = smooth / scale
    left = values - smooth @ torch.linalg.lstsq(smooth, values[:, None], driver="gelsd").solution[:, 0]
    # A corner of the command is no ripple.
    most = _CLIPPED * left.abs().median()
    left = left.clamp(-most, most)
    # Half a period apart over the motion.
    orders = torch.arange(2 * math.pi / span, max(_HIGHEST, 80 * math.pi / span), math.pi / span, dtype=torch.float64)
    power = torch.stack([torch.exp(1j * order * q).conj() @ left.to(torch.complex128) for order in orders]).abs()
    peak = (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
    ranked = torch.where(peak, power[1:-1], 0).argsort(descending=True)[:_MOST]
    return tuple(orders[1:-1][ranked].tolist())
