"""The effects that are tried, as one vector of numbers, and what any such vector makes of every axis."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.effects.registry import is_number, name_breaches
from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects import Facts, MotionEffect, Number
from ccnn_torch.motion.effects.bodies import CARRIED
from ccnn_torch.motion.effects.gears import FEWEST
from ccnn_torch.motion.effects.protocol import Act
from ccnn_torch.motion.effects.registry import OWN
from ccnn_torch.motion.stage import ABSENT
from ccnn_torch.plugins import users_code
from ccnn_torch.spelling import nearest_hint

# What may not be below 0, and what not above.
_POSITIVE = (
    *("inertia", "viscous", "coulomb", "load_friction", "stribeck", "weakness", "fading", "slowness", "ramp", "play"),
    *("dead_band", "flexibility", "gain", "integral", "derivative", "forward", "forward_lag", "supply"),
)
# With more damping a spring is no spring; a motor is no stronger than its voltage, but for an error of that.
_MOST = {"load_friction": 0.9, "flexible_damping": 0.3, "supply": 1.5}
# Share of the largest speed up to which friction may fall with the speed: what falls later is plain dry friction.
_SLOW = 0.5
# A spring without any damping never comes to rest.
_LEAST = {"cogging_order": FEWEST, "lead_order": 1.0, "flexible_damping": 1e-3}
# Plausible sizes up to which a simulator is linear in its own parameters.
_REACH = 0.6
# Plausible sizes: no number is larger.
_WIDEST = 1e3
# Log odds against what is seen less often than the rest, and can take the form of nearly anything.
_RARER = dict.fromkeys(("stribeck", "cogging", "transmission", "dead_band", "acceleration_limit"), math.log(0.1))
_SMALLEST = 1e-6
# Shapes that a fit refines from where they begin.
_REFINED = ("cogging_order", "lead_order", "stribeck_speed", "flexible_damping", "play_friction")


class Variant(NamedTuple):
    """One way to begin a fit of an effect.

    Attributes:
        effect: its number in the library.
        active: the numbers that a fit moves, places in the vector.
        values: where they begin, in plausible sizes, `n x len(active)`.
        held: places in the vector of shapes that are held at a value.
        shapes: those values, `n x len(held)`.
        log_prior: log of the share of the effect's prior that it has.
        free: places in the vector of shapes that a fit refines from there.
    """

    effect: int
    active: tuple[int, ...]
    values: Tensor
    held: tuple[int, ...]
    shapes: Tensor
    log_prior: float
    free: tuple[int, ...]


class Library(NamedTuple):
    """Effects of `n` axes whose numbers, in plausible sizes, stand in vectors of `k`.

    Attributes:
        effects: that are tried.
        facts: of each axis.
        numbers: of each axis, those of every effect one after the other; shapes that are held have none.
        size: `k`.
        places: places of each effect's numbers.
        variants: of each effect.
        held: place of every shape by the axis' parameter.
        nominal: parameters of the axes, `n` each.
        lacking: of each effect what every axis lacks to show it; "" where one axis can.
        there: whether an axis can show an effect that is tried, `n x effects`.
        twins: effects that are not tried, since another one does the same to every axis: which one, by their number.
        changes: what a unit of each number does to the axes' parameters: its place, the parameter, how, and by how
            much, `n`.
        about: what is added to each of a simulator's own parameters where it was linearised.
    """

    effects: tuple[MotionEffect, ...]
    facts: tuple[Facts, ...]
    numbers: tuple[tuple[Number, ...], ...]
    size: int
    places: tuple[tuple[int, ...], ...]
    variants: tuple[tuple[Variant, ...], ...]
    held: dict[str, int]
    nominal: dict[str, Tensor]
    lacking: tuple[str, ...]
    there: Tensor
    twins: Mapping[int, int]
    changes: tuple[tuple[int, str, str, Tensor], ...]
    about: Mapping[str, float] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Least and largest value of every number, `n x k` each: what is not negative in nature stays so."""
        low = torch.full((len(self.facts), self.size), -_WIDEST, dtype=torch.float64)
        high = -low
        for i, axis in enumerate(self.numbers):
            for j, number in enumerate(axis):
                for name, factor, how in number.acts:
                    if name.startswith(OWN):
                        centre = self.about.get(number.name, 0.0) / number.scale
                        low[i, j], high[i, j] = centre - _REACH, centre + _REACH
                    if how == "add" and name in _POSITIVE and factor:
                        nominal = self.facts[i].nominal.get(name, ABSENT[name])
                        low[i, j] = max(float(low[i, j]), -nominal / (factor * number.scale))
                        high[i, j] = min(float(high[i, j]), (_MOST.get(name, math.inf) - nominal) / number.scale)
                if number.most is not None:
                    most = number.most / number.scale
                    low[i, j], high[i, j] = max(float(low[i, j]), -most), min(float(high[i, j]), most)
        # 0 would stand for a shape that is not used.
        for name, place in self.held.items():
            low[:, place], high[:, place] = _LEAST.get(name, _SMALLEST), _MOST.get(name, _WIDEST)
        if "stribeck_speed" in self.held:
            high[:, self.held["stribeck_speed"]] = torch.tensor([_SLOW * axis.speed for axis in self.facts])
        return low, high

    def repeating(self, ripples: Sequence[tuple[float, ...]]) -> Library:
        """The same with other periods, of each axis, from which a fit of a wave may begin."""
        facts = [replace(own, ripples=others) for own, others in zip(self.facts, ripples, strict=True)]
        return library_of(self.effects, facts)._replace(about=self.about)

    def parameters(self, theta: Tensor, axis: Tensor) -> dict[str, Tensor]:
        """Parameters of axes.

        Args:
            theta: numbers in plausible sizes, `p x k`.
            axis: which axis each row is of, `p`.

        Returns:
            Of every parameter that is not absent everywhere, `p`.
        """
        found = {name: value[axis] for name, value in self.nominal.items()}
        used = (theta != 0).any(0).tolist()
        for j, name, how, size in self.changes:
            if used[j]:
                amount = theta[:, j] * size[axis]
                before = found.get(name, torch.full_like(amount, ABSENT.get(name, 0.0)))
                found[name] = before + amount if how == "add" else before * amount.clamp(-5, 5).exp()
        for name, place in self.held.items():
            if used[place]:
                value = theta[:, place]
                found[name] = torch.where(value != 0, value, found.get(name, torch.full_like(value, ABSENT[name])))
        for name in _POSITIVE:
            if name in found:
                found[name] = found[name].clamp(0, _MOST.get(name, math.inf))
        return found


def refuse_wrong_effect(effect: MotionEffect, facts: Sequence[Facts]) -> None:
    """Raise `InputError` where an effect does not keep to `MotionEffect` on the axes of a machine."""
    for i, axis in enumerate(facts):
        where = f"effect '{effect.name}', joint {i + 1}"
        parts: dict[str, Any] = {}
        for call in ("missing", "numbers", "shapes"):
            with users_code(where, f"{call} "):
                parts[call] = getattr(effect, call)(axis)
        for breach in _breaches(**parts):
            raise InputError(f"{where}: {breach}")


def _breaches(missing: object, numbers: Sequence[object], shapes: Any) -> Iterator[str]:
    """What the answers of an effect break of `MotionEffect`, one sentence each without a full stop."""
    if not isinstance(missing, str):
        yield f"missing must return a text, empty where nothing lacks, not {missing!r}"
    strange = [number for number in numbers if not isinstance(number, Number)]
    if strange or not numbers:
        yield f"numbers must return at least one Number, and nothing else{f', not {strange[0]!r}' if strange else ''}"
    known = [number for number in numbers if isinstance(number, Number)]
    yield from name_breaches([number.name for number in known], "numbers")
    for number in known:
        if not (is_number(number.scale) and number.scale > 0 and is_number(number.start)):
            yield f"'{number.name}' needs a finite scale above 0 and a finite start"
        for act in number.acts:
            fine = isinstance(act, Act) and act.how in ("add", "factor") and is_number(act.factor)
            if not fine or not (act.parameter in ABSENT or act.parameter == CARRIED or act.parameter.startswith(OWN)):
                hint = nearest_hint(act.parameter, [*ABSENT]) if isinstance(act, Act) else ""
                yield f"'{number.name}' acts by {act!r}, which is on no parameter of an axis{hint}"
    if not isinstance(shapes, Sequence) or not shapes or not all(isinstance(s, Mapping) for s in shapes):
        yield f"shapes must return at least one dict, which may be empty, not {shapes!r}"
    names = {number.name for number in known}
    for key, value in (item for shape in shapes for item in shape.items()):
        meant = key in names or (key in ABSENT and value is not None)
        if not meant or not (value is None or is_number(value)):
            yield (
                f"the shape {{'{key}': {value}}} is neither a start of one of its numbers nor a finite value of a "
                "parameter of an axis"
            )


def _kinds(numbers: Sequence[Number]) -> list[tuple[str, list[tuple[str, str]]]]:
    return [(number.name, [(act.parameter, act.how) for act in number.acts]) for number in numbers]


def library_of(effects: Sequence[MotionEffect], facts: Sequence[Facts]) -> Library:
    """The library for some axes.

    Raises:
        InputError: an effect does not keep to `MotionEffect`.
    """
    for effect in effects:
        refuse_wrong_effect(effect, facts)
    lacking = [[effect.missing(axis) for axis in facts] for effect in effects]
    numbers: list[list[Number]] = [[] for _ in facts]
    places: list[tuple[int, ...]] = []
    for effect in effects:
        own = [tuple(effect.numbers(axis)) for axis in facts]
        begin = len(numbers[0])
        for of_axis, those in zip(numbers, own, strict=True):
            # An axis that is driven otherwise than the first one has its numbers.
            of_axis += those if _kinds(those) == _kinds(own[0]) else own[0]
        places.append(tuple(range(begin, len(numbers[0]))))
    names = [{numbers[0][j].name for j in own} for own in places]
    shapes = [[effect.shapes(axis) for axis in facts] for effect in effects]
    fixed = dict.fromkeys(
        n
        for s, own in zip(shapes, names, strict=True)
        for one in s[0]
        for n, value in one.items()
        if n not in own and value is not None
    )
    held = {name: len(numbers[0]) + k for k, name in enumerate(fixed)}

    def variant(e: int, k: int, count: int) -> Variant:
        of_axes = [s[k] for s in shapes[e]]
        own = [name for name, value in of_axes[0].items() if name not in names[e] and value is not None]
        active = [j for j in places[e] if of_axes[0].get(numbers[0][j].name, 0.0) is not None]
        values = [
            [
                n.start if value is None else value / n.scale
                for n in (axis[j] for j in active)
                for value in [given.get(n.name)]
            ]
            for given, axis in zip(of_axes, numbers, strict=True)
        ]
        return Variant(
            e,
            tuple(active),
            torch.tensor(values, dtype=torch.float64),
            tuple(held[name] for name in own),
            torch.tensor([[given[name] for name in own] for given in of_axes], dtype=torch.float64),
            -math.log(count) + _RARER.get(effects[e].name, 0.0),
            tuple(held[name] for name in own if name in _REFINED),
        )

    same: dict[Any, int] = {}
    acts = [
        str([[(n.scale, n.start, n.acts) for n in axis[own[0] : own[-1] + 1]] for axis in numbers])
        + str([[*map(dict, axis)] for axis in shapes[e]] + lacking[e])
        for e, own in enumerate(places)
    ]
    twins = {e: first for e, act in enumerate(acts) if (first := same.setdefault(act, e)) != e}
    counts = [min(map(len, s)) for s in shapes]
    nominal = {
        name: torch.tensor([axis.nominal.get(name, value) for axis in facts], dtype=torch.float64)
        for name, value in ABSENT.items()
        if any(axis.nominal.get(name, value) != value for axis in facts)
    }
    return Library(
        tuple(effects),
        tuple(facts),
        tuple(map(tuple, numbers)),
        len(numbers[0]) + len(held),
        tuple(places),
        tuple(tuple(variant(e, k, count) for k in range(count)) for e, count in enumerate(counts)),
        held,
        nominal,
        tuple("" if not all(why) else why[0] for why in lacking),
        torch.tensor([[not why[i] and e not in twins for e, why in enumerate(lacking)] for i in range(len(facts))]),
        twins,
        tuple(
            (j, act.parameter, act.how, torch.tensor(sizes, dtype=torch.float64))
            for j, number in enumerate(numbers[0])
            for a, act in enumerate(number.acts)
            for sizes in [[own[j].scale * own[j].acts[a].factor for own in numbers]]
        ),
    )
