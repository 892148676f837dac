"""Limits of the parameters of a simulated effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from ccnn_torch.coordinates import Parameter
from ccnn_torch.effects import Acting, Effect, Situation
from ccnn_torch.errors import InputError

# Times its plausible size: beyond this the unit must be wrong (mm for m, degrees for radians).
_ABSURD = 1000.0


def refuse_impossible(name: str, effect: Effect, situation: Situation, values: Mapping[str, float]) -> None:
    """Refuse given parameters that no machine has.

    Args:
        name: of the effect, as the command line has it.
        values: given parameters by name [SI].

    Raises:
        InputError: a coefficient below 0 that physics allows no negative value, one a thousand times its plausible
            size, or a shape below 0 whose grid is not.
    """
    for c in effect.coefficients(situation):
        value = values.get(c.name, 0.0)
        given, usual = f"--effect {name}: {c.name} = {_text(value, c.unit)}", _text(c.scale, c.unit)
        if c.positive and value < 0:
            raise InputError(f"{given} is below 0, which physics does not allow; plausible is about {usual}")
        if abs(value) > _ABSURD * c.scale:
            raise InputError(f"{given} is more than {_ABSURD:g} times what a machine has; plausible is about {usual}")
    for s in effect.shapes(situation):
        if s.grid[0] >= 0 > values.get(s.name, 0.0):
            raise InputError(
                f"--effect {name}: {s.name} = {_text(values[s.name], s.unit)} is below 0; on these rows a diagnosis "
                f"searches from {s.grid[0]:g} to {_text(s.grid[-1], s.unit)}"
            )


def refuse_beyond_bounds(situation: Situation, acting: Sequence[Acting]) -> None:
    """Refuse parameters of the machine that all effects together bring beyond their bounds.

    Raises:
        InputError: names the parameter, what it would be and what may be given.
    """
    changing = [one for one in acting if one.effect.kind == "parameters"]
    if not changing:
        return
    nominal = situation.mechanism.resolve(situation.parameters)
    changes = [one.change(situation).reshape(-1, len(situation.mechanism.geometry)) for one in changing]
    for k, parameter in enumerate(situation.mechanism.geometry):
        at = torch.stack([change[:, k] for change in changes]).sum(0) + nominal[..., k]
        least, most = float(at.amin()), float(at.amax())
        low = parameter.low is not None and least < parameter.low
        if low or (parameter.high is not None and most > parameter.high):
            names = [one.effect.name for one, change in zip(changing, changes, strict=True) if change[:, k].any()]
            there = least if low else most
            raise InputError(
                f"--effect {names[0]}: {parameter.name} would be {_text(there, parameter.unit)}, and the mechanism has "
                f"it {_range(parameter, 0.0)}; give a difference to its nominal {parameter.nominal:g} "
                f"{_range(parameter, parameter.nominal)}"
            )


def _range(parameter: Parameter, zero: float) -> str:
    low, high = ((None if end is None else f"{end - zero:g}") for end in (parameter.low, parameter.high))
    if low is not None and high is not None:
        return f"from {low} to {high}"
    return f"from {low} up" if high is None else f"up to {high}"


def _text(value: float, unit: str) -> str:
    return f"{value:g} {unit}".removesuffix(" 1")
