"""Inputs of a simulator from the records, and rows without a pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Condition
from ccnn_torch.effects import Situation
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, Framed, Mechanism
from ccnn_torch.records import Records
from ccnn_torch.units import LARGEST, parse_header, si_unit_of


def simulator_inputs(
    records: Records, mechanism: Mechanism, covariates: Mapping[str, Tensor]
) -> tuple[Mechanism, dict[str, Tensor]]:
    """What the nominal machine takes from the records beyond the covariates that every diagnosis uses.

    Args:
        records: with all their columns.
        mechanism: the nominal one.
        covariates: by name, `s` each, those that are known already.

    Returns:
        The mechanism with what is constant in all rows (no driver of anything, but no less true), and further
        covariates that vary, `s` each [SI].

    Raises:
        InputError: a column that it takes has an empty cell or another unit.
    """
    constant: dict[str, Tensor] = {}
    varying: dict[str, Tensor] = {}
    for condition in mechanism.takes:
        if condition.name in covariates or condition.name not in records.columns:
            continue
        values = torch.from_numpy(_column(records, condition))
        if float(values.max() - values.min()) > 0:
            varying[condition.name] = values
        else:
            constant[condition.name] = values[0]
    return mechanism.under(constant), varying


def refuse_lost_rows(records: Records, situation: Situation) -> None:
    """A simulator answers for every row that was measured; other machines may have rows out of reach, set aside later.

    Raises:
        InputError: it returns NaN for some; names the first of them and how many there are.
    """
    machine = situation.machine.mechanism if isinstance(situation.machine, Framed) else situation.machine
    if not isinstance(machine, BlackBox):
        return
    lost = np.flatnonzero(~torch.isfinite(situation.pose).all(-1).numpy())
    if len(lost) == 0:
        return
    row = int(lost[0])
    rest = f" (and {len(lost) - 1} more)" if len(lost) > 1 else ""
    raise InputError(
        f"{records.path}: simulator '{machine.name}' returns NaN at {records.name_rows([row])}{rest}, with "
        f"{machine.words(situation.joints[row], row)}; let it return a pose there, check the units, or remove the row"
        f"{'s' if len(lost) > 1 else ''}"
    )


def _column(records: Records, condition: Condition) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values, unit = records.columns[condition.name], records.units[condition.name]
    where = f"{records.path}: column '{condition.name}'"
    if not unit:
        parse_header(condition.name, records.path, condition.unit)
    if si_unit_of(unit, where) != si_unit_of(condition.unit):
        raise InputError(f"{where} is in '{unit}', and the simulator takes it in {condition.unit}")
    empty = np.flatnonzero(~np.isfinite(values))
    if len(empty):
        raise InputError(f"{where} is empty at {records.name_rows(empty[:1])}, and the simulator takes it; fill it in")
    far = np.flatnonzero(np.abs(values) > LARGEST)
    if len(far):
        raise InputError(f"{where} has {values[far[0]]:g} at {records.name_rows(far[:1])}, which is nothing measured")
    return np.array(values, dtype=np.float64).reshape(-1)
