"""Logs and a nominal model by its name, as what is fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.motion.effects import Facts, MotionEffect
from ccnn_torch.motion.library import library_of
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.nominal import Driven, Nominal, own_simulator
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.ripples import torque_ripples
from ccnn_torch.motion.servo import servo
from ccnn_torch.motion.stretches import Stretches, cut_stretches, nearly_largest
from ccnn_torch.plugins import is_plugin

# Seconds over which samples are averaged before they are judged.
_POOLED = 0.02


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
        ripples=torque_ripples(data.position[i], driven.followed[i], data.time, judged, nominal.axes[i]),
    )


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
