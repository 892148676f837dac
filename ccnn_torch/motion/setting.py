"""Logs and a nominal model by its name, as what is fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.motion.effects import Facts, MotionEffect
from ccnn_torch.motion.library import library_of
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.nominal import Driven, Nominal, own_simulator
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.servo import servo
from ccnn_torch.motion.stretches import Stretches, cut_stretches, direction, nearly_largest
from ccnn_torch.plugins import is_plugin

# Seconds over which samples are averaged before they are judged.
_POOLED = 0.02
# Periods in a turn up to which a torque is looked for that repeats with the position, and how many of them are tried.
_HIGHEST, _RIPPLES = 200.0, 4
# Median sizes at which what is left of the torque is clipped.
_CLIPPED = 3.0


def problem_of(logs: Sequence[Log], nominal: Nominal, effects: Sequence[MotionEffect]) -> Problem:
    """Logs and a nominal model as what is fitted.

    Raises:
        InputError: the logs cannot show any of the effects, or cannot be used.
    """
    data = cut_stretches(logs)
    driven = nominal.driven(logs, data)
    if driven.torque is not None:
        data = data.under(driven.torque)
    facts = [_facts(data, i, nominal, driven) for i in range(len(data.units))]
    library = library_of(effects, facts)
    if all(library.lacking):
        need = "; ".join(f"{name} needs {why}" for name, why in zip(library.names, library.lacking, strict=True))
        raise InputError(f"effects: these logs can show none of the candidates: {need}")
    span = data.position.amax((-1, -2)) - data.position.amin((-1, -2))
    unit = torch.exp2((1e-3 * span).clamp_min(1e-12).log2().round())
    pool = max(round(_POOLED / float(data.time.diff(dim=-1).median())), 1)
    return Problem(data, library, driven, unit, pool, known=nominal.known)


def _facts(data: Stretches, i: int, nominal: Nominal, driven: Driven) -> Facts:
    judged = data.judged

    span = float(data.command[i][judged].max() - data.command[i][judged].min())
    # Between runs other things than the temperature change as well.
    runs = [driven.warm[data.run == run][judged[data.run == run]] for run in set(data.run.tolist())]
    return Facts(
        unit=data.units[i],
        nominal=nominal.axes[i],
        gain=nominal.gains[i],
        length=nominal.lengths[i],
        carried=None if driven.carried is None else float(nearly_largest(driven.carried[i][judged])),
        heaviest=nominal.heaviest,
        span=span or 1.0,
        speed=float(nearly_largest(data.speed[i][judged])) or 1.0,
        error=float(nearly_largest((driven.followed[i] - data.position[i])[judged])) or 1e-6,
        supply=float(driven.supply[judged].abs().max()) if "supply" in data.beside else 0.0,
        temperature=max(float(v.max() - v.min()) for v in runs),
        ripples=_ripples(data.position[i], driven.followed[i], data.time, judged, nominal.axes[i]),
    )


def _ripples(
    position: Tensor, command: Tensor, time: Tensor, judged: Tensor, nominal: Mapping[str, float]
) -> tuple[float, ...]:
    """Periods in a turn that repeat most in the torque which the nominal model lacks.

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
    motor = u - q + nominal.get("derivative", 0.0) * (w - v)
    torque = nominal.get("inertia", 0.0) * a + nominal.get("viscous", 0.0) * v - motor
    span = float(q.max() - q.min()) or 1.0
    x = (q - q.mean()) / span
    # Of a model without inertia and friction command and position are all of the torque.
    gain = [u] if nominal.get("inertia") or nominal.get("viscous") else []
    smooth = torch.stack(
        [torch.ones_like(x), *(x**k for k in range(1, 6)), *gain, w, direction(w, w.abs().mean()), f], -1
    )
    scale = smooth.square().mean(0).sqrt().clamp_min(1e-300)
    smooth = smooth / scale
    left = torque - smooth @ torch.linalg.lstsq(smooth, torque[:, None], driver="gelsd").solution[:, 0]
    # A corner of the command is no ripple.
    most = _CLIPPED * left.abs().median()
    left = left.clamp(-most, most)
    # Half a period apart over the motion.
    orders = torch.arange(2 * math.pi / span, max(_HIGHEST, 80 * math.pi / span), math.pi / span, dtype=torch.float64)
    power = torch.stack([torch.exp(1j * order * q).conj() @ left.to(torch.complex128) for order in orders]).abs()
    peak = (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
    ranked = torch.where(peak, power[1:-1], 0).argsort(descending=True)[:_RIPPLES]
    return tuple(orders[1:-1][ranked].tolist())


def nominal_of(mechanism: str, keys: Mapping[str, Any], units: Sequence[str]) -> Nominal:
    """The nominal model by its name.

    Args:
        mechanism: `servo`, a simulator `file.py:NAME`, an MJCF with position actuators, or a mechanism.
        keys: of the built-in servo (`KEYS`), or of the mechanism.
        units: of the joints in the logs.

    Raises:
        InputError: a name or a key is not known, or the model has another number of joints than the logs.
    """
    n = len(units)
    if mechanism == "servo":
        return servo(keys, n)
    nothing = Nominal(mechanism, ({},) * n, (None,) * n, (None,) * n)
    if is_plugin(mechanism):
        return replace(nothing, simulator=own_simulator(mechanism, keys))
    if Path(mechanism).suffix.lower() in (".xml", ".mjcf") and Path(mechanism).is_file():
        from ccnn_torch.motion.mujoco_motion import mujoco_nominal

        if "<mujoco" in read_text(mechanism, CONFIG_LIMIT, "write an MJCF"):
            return mujoco_nominal(mechanism, keys, units)
    own = [joint.unit for joint in load_mechanism(mechanism, **keys).joints]
    if own != list(units):
        raise InputError(
            f"{mechanism}: has {len(own)} joints ({', '.join(own)}), and the logs {len(units)} ({', '.join(units)}); "
            "name the commands command1… and the positions q1… in the mechanism's order"
        )
    return nothing
