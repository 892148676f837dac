"""Trial of a user's effect on the rows, before it is used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from numbers import Real

import torch

from ccnn_torch.effects.protocol import Coefficient, Effect, Shape
from ccnn_torch.effects.registry import OUTLIER, effect_names
from ccnn_torch.effects.situation import Situation
from ccnn_torch.effects.user_effect import OwnEffect, of_library
from ccnn_torch.errors import InputError
from ccnn_torch.units import to_si


def tried(effect: Effect, situation: Situation) -> str:
    """What the rows lack for an effect, as `Effect.missing` states it; a user's own is tried on them where that is ''.

    Args:
        effect: as `make_effect` or `owned` gives it; the library's are not tried.
        situation: `... x s` rows.

    Raises:
        InputError: one sentence with file and method where the effect breaks the contract of `Effect`.
    """
    if isinstance(effect, OwnEffect):
        wrong = _wrong_name(effect, situation)
        if wrong:
            raise InputError(f"{effect.label}: {wrong}")
    lacks = effect.missing(situation.mechanism, [*situation.covariates])
    if isinstance(effect, OwnEffect) and not lacks:
        wrong = _wrong_with(effect, situation)
        if wrong:
            raise InputError(f"{effect.label}: {wrong}")
    return lacks


def refuse_one_name(effects: Sequence[Effect]) -> None:
    """Raise InputError where two candidates are called the same: a verdict could not distinguish them."""
    names = [e.name for e in effects]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is None:
        return
    own = [e.label for e in effects if isinstance(e, OwnEffect) and e.name == twice]
    what = f" ({' and '.join(own)})" if own else ""
    raise InputError(f"effects: two candidates are called '{twice}'{what}; name each once, and give each its own name")


def _wrong_with(effect: OwnEffect, situation: Situation) -> str:
    """What its coefficients and shapes break, '' where nothing; the basis is asked at the middle and the ends of grids.

    Args:
        effect: one whose `missing` finds nothing missing.
        situation: `... x s` rows.

    Raises:
        InputError: a call fails, or returns what is no list of coefficients, no shapes or no basis.
    """
    found, shapes = effect.coefficients(situation), effect.shapes(situation)
    if all(c.secondary for c in found):
        none = "has no coefficient that is not secondary" if found else "returned no coefficient"
        return f"coefficients() {none}; where there is nothing to fit, missing() must say why"
    names = [c.name for c in found] + [s.name for s in shapes]
    odd = next((n for n in names if not isinstance(n, str) or not n.strip()), None)
    if odd is not None:
        return f"one of its coefficients or shapes is called {odd!r}, expected a name"
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        return f"two of its coefficients or shapes are called '{twice}'; give each its own name"
    for one in found:
        wrong = _wrong_coefficient(one, situation)
        if wrong:
            return f"coefficients(): {wrong}"
    for shape in shapes:
        wrong = _wrong_shape(shape, len(found))
        if wrong:
            return f"shapes(): {wrong}"
    grids = [s.grid for s in shapes]
    middle, low, high = ([g[share * (len(g) - 1) // 2] for g in grids] for share in (1, 0, 2))
    at = torch.tensor(middle, dtype=torch.float64)
    if not torch.equal(effect.basis(situation, at), effect.basis(situation, at)):
        return "basis() gives other values when called again; an effect draws no random numbers and keeps no state"
    if grids:
        # As a search asks: several sets of shapes at once.
        effect.basis(situation, torch.tensor([middle, low, high], dtype=torch.float64))
    return ""


def _wrong_name(effect: OwnEffect, situation: Situation) -> str:
    if not effect.name.strip() or not effect.name.isprintable():
        return f"its name is {effect.name!r}, expected a word or two"
    if not of_library(effect.own) and effect.name in (*effect_names(situation.mechanism), OUTLIER):
        return f"its name '{effect.name}' is one of the library's, which a verdict would mean; give it one of its own"
    return ""


def _wrong_coefficient(one: Coefficient, situation: Situation) -> str:
    if not (_is_number(one.scale) and one.scale > 0):
        return (
            f"coefficient '{one.name}' has the scale {one.scale!r}, expected more than 0: its plausible size in "
            f"{one.unit}"
        )
    joints = [j.name for j in situation.mechanism.joints]
    legs = sorted({g.leg for g in situation.mechanism.geometry if g.leg is not None})
    if one.joint is not None and one.joint not in joints:
        return f"coefficient '{one.name}' is of joint {one.joint!r}, expected one of {', '.join(joints)}, or None"
    if one.leg is not None and one.leg not in legs:
        there = f"one of {', '.join(map(str, legs))}, or None" if legs else "None: the mechanism's parameters name none"
        return f"coefficient '{one.name}' is of leg {one.leg!r}, expected {there}"
    return _wrong_unit(one.name, one.unit)


def _wrong_shape(shape: Shape, coefficients: int) -> str:
    grid = shape.grid
    if not isinstance(grid, tuple | list) or not grid or not all(map(_is_number, grid)):
        got = "is empty" if isinstance(grid, tuple | list) and not grid else f"is {grid!r}"
        return f"the grid of shape '{shape.name}' {got}, expected finite numbers to look at, e.g. (0.5, 1.0, 2.0)"
    if not all(a < b for a, b in pairwise(grid)):
        return f"the grid of shape '{shape.name}' does not ascend"
    if shape.usual is not None and not _is_number(shape.usual):
        return f"shape '{shape.name}' has the usual value {shape.usual!r}, expected a number or None"
    if shape.columns is not None:
        wrong = [k for k in shape.columns if k not in range(coefficients)]
        if wrong or not shape.columns:
            named = f"names coefficient {wrong[0]!r}" if wrong else "names no coefficient"
            return f"shape '{shape.name}' {named} in columns, expected numbers from 0 to {coefficients - 1}, or None"
    return _wrong_unit(shape.name, shape.unit)


def _wrong_unit(name: str, unit: object) -> str:
    if not isinstance(unit, str):
        return f"the unit of '{name}' is {unit!r}, expected a name of an SI unit such as 'm/N', or '1'"
    try:
        one = float(to_si([1.0], unit, where="it")[0])
    except InputError as reason:
        return f"the unit of '{name}' is none: {reason}"
    return "" if one == 1.0 else f"the unit '{unit}' of '{name}' is no SI unit"


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)
