"""Logs and a nominal model as what is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects import Facts, MotionEffect
from ccnn_torch.motion.library import library_of
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.nominal import Driven, Nominal
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.stretches import Stretches, cut_stretches

# Seconds over which samples are averaged before they are judged.
_POOLED = 0.02
# Quantile of what counts as nearly the largest.
_NEARLY = 0.98


def problem_of(logs: Sequence[Log], nominal: Nominal, effects: Sequence[MotionEffect]) -> Problem:
    """Logs and a nominal model as what is fitted.

    Raises:
        InputError: the logs cannot show any of the effects, or cannot be used.
    """
    data = cut_stretches(logs)
    driven = nominal.driven(logs, data)
    supply = torch.zeros_like(data.time)
    if "supply" in data.beside:
        usual = nominal.supply or float(data.beside["supply"][data.judged].median())
        supply = data.beside["supply"] / usual - 1 if usual else supply
    warm = torch.zeros_like(data.time)
    if "temperature" in data.beside:
        warm = data.beside["temperature"] - data.beside["temperature"][data.judged].min()
    facts = [_facts(data, i, nominal, driven, supply, warm) for i in range(len(data.units))]
    library = library_of(effects, facts)
    if all(library.lacking):
        need = "; ".join(f"{name} needs {why}" for name, why in zip(library.names, library.lacking, strict=True))
        raise InputError(f"effects: these logs can show none of the candidates: {need}")
    pool = max(round(_POOLED / float(data.time.diff(dim=-1).median())), 1)
    return Problem(data, library, pool=pool, supply=supply, warm=warm, **driven._asdict())


def _facts(data: Stretches, i: int, nominal: Nominal, driven: Driven, supply: Tensor, warm: Tensor) -> Facts:
    judged = data.judged

    def nearly(values: Tensor) -> float:
        kept = values.abs().flatten()
        return float(torch.quantile(kept[:: max(len(kept) // 100_000, 1)], _NEARLY))

    span = float(data.command[i][judged].max() - data.command[i][judged].min())
    # Between runs other things than the temperature change as well.
    runs = [warm[data.run == run][judged[data.run == run]] for run in set(data.run.tolist())]
    return Facts(
        unit=data.units[i],
        nominal=nominal.axes[i],
        gain=nominal.gains[i],
        length=nominal.lengths[i],
        carried=None if driven.carried is None else nearly(driven.carried[i][judged]),
        heaviest=nominal.heaviest,
        span=span or 1.0,
        speed=nearly(data.speed[i][judged]) or 1.0,
        error=nearly((driven.followed[i] - data.position[i])[judged]) or 1e-6,
        supply=float(supply[judged].abs().max()) if "supply" in data.beside else 0.0,
        temperature=max(float(v.max() - v.min()) for v in runs),
    )
