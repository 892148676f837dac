"""Parse `NAME:parameter=value,…` into an effect with values."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.effects import EFFECTS, OUTLIER, Acting, Coefficient, Effect, Situation, make_effect, tried
from ccnn_torch.errors import InputError
from ccnn_torch.spelling import nearest
from ccnn_torch.units import to_si

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


_FORM = re.compile(r"(?P<name>.+?\.py:[^:]+|[^:]+)(?::(?P<rest>.*))?")
_VALUE = re.compile(r"(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\s\d].*)?")
SIZE = "size"
_DRAWN = (0.5, 1.5)
# Largest plausible factor.
_LARGEST = 1000.0


@dataclass(frozen=True)
class Wanted:
    """An effect as the command line names it: `values` as they were written."""

    name: str
    values: dict[str, str]

    @property
    def outlier(self) -> bool:
        """Whether it is the effect of bad rows."""
        return self.name == OUTLIER


@dataclass(frozen=True)
class Injected:
    """What was put into a simulated machine.

    Attributes:
        name: of the effect.
        parameters: coefficients that are not 0, and shapes that these depend on, by name: value [SI] and unit.
        gap: root of the mean square of the position's change by this effect alone [m].
    """

    name: str
    parameters: dict[str, tuple[float, str]]
    gap: float


def read_wanted(text: str) -> Wanted:
    """Parse `NAME`, `NAME:parameter=value,…` or `file.py:Name:parameter=value,…`.

    Raises:
        InputError: it is not of that form.
    """
    match = _FORM.fullmatch(text.strip())
    parts = [p.strip() for p in (match["rest"] or "").split(",") if p.strip()] if match else []
    pairs = [part.partition("=") for part in parts]
    if match is None or not all(equals and name.strip() and value.strip() for name, equals, value in pairs):
        raise InputError(f"--effect {text}: write NAME or NAME:parameter=value,parameter=value")
    return Wanted(match["name"].strip(), {name.strip(): value.strip() for name, _, value in pairs})


def act(wanted: Wanted, situation: Situation, generator: torch.Generator) -> Acting:
    """The effect with its numbers: those given, or drawn where none are.

    Given coefficients leave all others 0. Without any, those that are not secondary are drawn, half to one and a half
    times their plausible size, with either sign where physics allows both; `size` is a factor on that. Shapes that are
    not given are drawn from the lower half of their grid.

    Raises:
        InputError: no such effect, one that these rows cannot show, a parameter that it does not have, a value that no
            machine has, or a user's own effect that violates `Effect`.
    """
    if wanted.name not in EFFECTS and nearest(wanted.name, [OUTLIER], 0.8):
        raise InputError(f"effects: '{wanted.name}' is no effect; did you mean '{OUTLIER}'?")
    effect = make_effect(wanted.name, situation.mechanism)
    missing = tried(effect, situation)
    if missing:
        raise InputError(f"--effect {wanted.name}: it needs {missing}")
    found, shapes = effect.coefficients(situation), effect.shapes(situation)
    values = _values(wanted, effect, units_of(effect, situation) | {SIZE: "1"})
    size = values.pop(SIZE, 1.0)
    if not 0 <= size <= _LARGEST:
        raise InputError(f"--effect {wanted.name}: {SIZE} = {size:g}: give a factor from 0 to {_LARGEST:g}")
    refuse_impossible(wanted.name, effect, situation, values)
    drawn = _drawn(found, generator) * size
    if any(c.name in values for c in found):
        drawn = torch.tensor([values.get(c.name, 0.0) for c in found], dtype=torch.float64)
    at = []
    for shape in shapes:
        pick = int(torch.randint(max(len(shape.grid) // 2, 1), (), generator=generator))
        usual = shape.grid[pick] if shape.usual is None else shape.usual
        at.append(values.get(shape.name, usual))
    return Acting(effect, torch.tensor(at, dtype=torch.float64), drawn)


def units_of(effect: Effect, situation: Situation) -> dict[str, str]:
    """SI unit of every coefficient and shape, by name."""
    units = {c.name: c.unit for c in effect.coefficients(situation)}
    return units | {s.name: s.unit for s in effect.shapes(situation)}


def _drawn(found: Sequence[Coefficient], generator: torch.Generator) -> Tensor:
    part = torch.rand(2, len(found), generator=generator, dtype=torch.float64)
    low, high = _DRAWN
    signs = torch.where(part[1] < 0.5, -1.0, 1.0)
    scale = torch.tensor([0.0 if c.secondary else c.scale for c in found], dtype=torch.float64)
    positive = torch.tensor([c.positive for c in found])
    return scale * (low + (high - low) * part[0]) * torch.where(positive, 1.0, signs)


def _values(wanted: Wanted, effect: Effect, units: dict[str, str]) -> dict[str, float]:
    """Parameters by their own names [SI]; blanks may be written as underscores."""
    names = {_plain(name): name for name in units}
    found = {}
    for written, text in wanted.values.items():
        name = names.get(_plain(written))
        if name is None:
            near = nearest(_plain(written), list(names))
            hint = f"did you mean '{near}'? It has" if near else "it has"
            raise InputError(
                f"--effect {wanted.name}: it has no parameter '{written}'; {hint} {', '.join(names)} "
                f"({SIZE} = a factor on what is drawn)"
            )
        match = _VALUE.fullmatch(text)
        if match is None:
            raise InputError(f"--effect {wanted.name}: {written}={text} is no number, with or without a unit")
        value = float(match["number"])
        if match["unit"]:
            where = f"--effect {wanted.name}: {written}={text}"
            value = float(to_si(np.array([value]), match["unit"].strip(), units[name], where, written)[0])
        found[name] = value
    return found


def _plain(name: str) -> str:
    return "_".join(name.lower().split())
