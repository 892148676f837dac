"""Parse `NAME:parameter=value,…` into an effect with values."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.effects import EFFECTS, OUTLIER, Acting, Coefficient, Effect, Situation, make_effect, tried
from ccnn_torch.errors import InputError
from ccnn_torch.simulation.limits import refuse_impossible
from ccnn_torch.spelling import nearest
from ccnn_torch.units import to_si

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
