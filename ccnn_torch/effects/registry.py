"""Effects by the names that configs and verdicts use."""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from ccnn_torch.effects.backlash import Backlash, Friction
from ccnn_torch.effects.constant import Flexure, Frame, Geometry, Instrument, Tool, parameter_causes
from ccnn_torch.effects.error_motion import ErrorMotion
from ccnn_torch.effects.joints import Coupling, JointGain, JointOffset, Transmission
from ccnn_torch.effects.loads import Bending, Compliance, Gravity, Sag, ThermalCompliance
from ccnn_torch.effects.protocol import Coefficient, Effect, Kind, Shape, missing_verbs
from ccnn_torch.effects.situation import Situation
from ccnn_torch.effects.thermal import Thermal
from ccnn_torch.effects.time import Drift, FrameDrift, Homing, Latency
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, sees_directions
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.plugins import class_hint, is_plugin, load_plugin, users_code
from ccnn_torch.units import to_si

_Part = TypeVar("_Part", Coefficient, Shape)


class OwnEffect:
    """An effect that is not the library's, as the rest of the package calls it.

    What its code raises, and what it returns in another form than `Effect` defines, becomes an InputError.
    """

    name: str
    kind: Kind
    description: str
    ordered: bool

    def __init__(self, own: Effect, label: str) -> None:
        """own: the user's object; label: opens the sentences, `path/to/file.py:Name`."""
        self.own = own
        self.label = label
        self.name, self.kind, self.description, self.ordered = own.name, own.kind, own.description, own.ordered

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """As `Effect.missing`.

        Raises:
            InputError: it fails, or returns something other than a sentence.
        """
        said = self._asked("missing", mechanism, covariates)
        if not isinstance(said, str):
            raise InputError(
                f"{self.label}: missing() returned {_a(said)}, expected a sentence that names the column to add, or ''"
            )
        return said

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """As `Effect.coefficients`.

        Raises:
            InputError: it fails, or returns something else.
        """
        return self._listed("coefficients", Coefficient, situation)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """As `Effect.shapes`.

        Raises:
            InputError: it fails, or returns something else.
        """
        return self._listed("shapes", Shape, situation)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """As `Effect.basis`, `... x s x d x m`.

        Raises:
            InputError: it fails, or gives no tensor, another shape, another precision or numbers that are not finite.
        """
        found = self._asked("basis", situation, shape)
        if not isinstance(found, Tensor):
            raise InputError(f"{self.label}: basis() returned {_a(found)}, expected a torch tensor")
        # A graph that is traced can ask no values, and was checked with numbers before.
        if not torch.compiler.is_compiling():
            wrong = self._wrong_form(situation, shape, found) or self._not_finite(situation, shape, found)
            if wrong:
                raise InputError(f"{self.label}: basis() {wrong}")
        return found

    def _asked(self, verb: str, *given: object) -> Any:
        try:
            with users_code(self.label, f"{verb}() "):
                return getattr(self.own, verb)(*given)
        except InputError as error:
            hint = _hint(error.__cause__, given[0])
            if not hint:
                raise
            raise InputError(f"{error}{hint}") from error.__cause__

    def _listed(self, verb: str, kind: type[_Part], situation: Situation) -> tuple[_Part, ...]:
        found = self._asked(verb, situation)
        listed = isinstance(found, tuple | list)
        strange = [f for f in found if not isinstance(f, kind)] if listed else [found]
        if strange:
            got = f"{_a(strange[0])} in {_a(found)}" if listed else _a(found)
            empty = "; () where there is none" if kind is Shape else ""
            raise InputError(
                f"{self.label}: {verb}() returned {got}, expected a tuple of {kind.__name__}, ({kind.__name__}(…),)"
                f"{empty}"
            )
        return tuple(found)

    def _wrong_form(self, situation: Situation, shape: Tensor, found: Tensor) -> str:
        changed, d = self._changed(situation)
        rows, m = situation.joints.shape[-2], len(self.coefficients(situation))
        over, sets = situation.joints[..., 0, :], shape.shape[:-1]
        # A basis without shapes need not repeat itself over sets of none.
        leads = [leading_shape(over, shape)] + ([] if shape.shape[-1] else [leading_shape(over)])
        if situation.parameters is not None and situation.parameters.dim() > 1:
            leads.append(leading_shape(over, shape, situation.parameters[..., 0, :]))
        if found.shape not in [(*lead, rows, d, m) for lead in leads]:
            many = f"; shape is {tuple(shape.shape)} here: take shape[..., 0] of it, and keep its leading dims"
            axes = f"{'sets of shapes, ' if sets else ''}rows, {changed} and coefficients{many if sets else ''}"
            return f"gives shape {tuple(found.shape)}, expected {(*leads[0], rows, d, m)}: {axes}"
        if found.dtype != situation.joints.dtype:
            return f"gives {found.dtype}, expected {situation.joints.dtype}"
        return ""

    def _changed(self, situation: Situation) -> tuple[str, int]:
        """What it changes, and how many of these the mechanism has."""
        mechanism = situation.mechanism
        if self.kind == "joints":
            return "joints", situation.joints.shape[-1]
        if self.kind == "parameters":
            return "parameters", len(mechanism.geometry)
        # Not by the situation's Jacobian, which may be slow, or recorded as something that the effect reads.
        return "pose channels", len(mechanism.channels)

    def _not_finite(self, situation: Situation, shape: Tensor, found: Tensor) -> str:
        if bool(torch.isfinite(found).all()):
            return ""
        # Rows that are not finite themselves promise nothing.
        known = torch.isfinite(situation.joints).all(-1)
        bad = ~torch.isfinite(found).all(-1).all(-1) & known
        if not bool(bad.any()):
            return ""
        here = bad.reshape(-1, bad.shape[-1]).any(0)
        posed = torch.isfinite(situation.pose).all(-1).reshape(-1, len(here)).all(0)
        lost = " where the nominal machine has no pose (torch.nan_to_num)" if not bool(posed[here].any()) else ""
        at = ""
        if shape.shape[-1]:
            values = shape.expand(*bad.shape[:-1], shape.shape[-1])[bad.any(-1)].reshape(-1, shape.shape[-1])[0]
            named = zip(self.shapes(situation), values.tolist(), strict=True)
            at = " at " + ", ".join(f"{s.name} = {value:g} {s.unit}" for s, value in named)
        count = "every row" if bool(here.all()) else f"{int(here.sum())} of {len(here)} rows"
        return f"is not finite in {count}{at}{lost}, expected finite numbers for finite rows"


def owned(effect: object, label: str | None = None) -> Effect:
    """The effect itself where it is the library's, else as `OwnEffect`.

    Args:
        effect: any object that is meant as an effect.
        label: opens the sentences; file and class when None.

    Raises:
        InputError: it is no effect.
    """
    if isinstance(effect, OwnEffect) or of_library(effect):
        return cast(Effect, effect)
    if isinstance(effect, type):
        raise InputError(f"effects: {effect.__name__} is a class; give an object of it, {effect.__name__}()")
    called = label_of(effect) if label is None else label
    lacking = missing_verbs(effect)
    if lacking:
        raise InputError(
            f"effects: {called} is no effect, it lacks {', '.join(lacking)} "
            "(ccnn_torch.testing.check_effect checks the whole protocol of an effect)"
        )
    return OwnEffect(cast(Effect, effect), called)


def of_library(effect: object) -> bool:
    """Whether an effect's class comes with this package, whose tests check it against `Effect`."""
    return type(effect).__module__.startswith(f"{__package__}.")


def label_of(effect: object) -> str:
    """`path/to/file.py:Name` of an object's class; the name alone where it comes from no file."""
    kind = type(effect)
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return f"{file}:{kind.__qualname__}" if file else kind.__qualname__


def _a(value: object) -> str:
    """`a numpy.ndarray`, for a value that should be something else."""
    kind = type(value)
    if value is None:
        return "None"
    return f"a {kind.__name__}" if kind.__module__ == "builtins" else f"a {kind.__module__}.{kind.__name__}"


def _hint(error: BaseException | None, given: object) -> str:
    """A column that is not there is what mostly lacks of a mapping by name."""
    if not (isinstance(error, KeyError) and isinstance(given, Situation)):
        return ""
    return f" (if that is a column: the rows have {', '.join(given.covariates) or 'none'}, and missing() must say so)"


def missing_on(effect: Effect, situation: Situation) -> str:
    """Columns that the rows lack for an effect, as a sentence; empty where they lack none.

    Args:
        effect: as `make_effect` or `owned` gives it; the library's are not tried.
        situation: `... x s` rows.

    Raises:
        InputError: one sentence with file and method where the effect breaks the contract of `Effect`.
    """
    if isinstance(effect, OwnEffect):
        for breach in _breaches(effect, situation):
            raise InputError(f"{effect.label}: {breach}")
    return effect.missing(situation.mechanism, [*situation.covariates])


def check_names(effects: Sequence[Effect]) -> None:
    """Raise InputError where two candidates are called the same: a verdict could not distinguish them."""
    names = [e.name for e in effects]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is None:
        return
    own = [e.label for e in effects if isinstance(e, OwnEffect) and e.name == twice]
    what = f" ({' and '.join(own)})" if own else ""
    raise InputError(f"effects: two candidates are called '{twice}'{what}; name each once, and give each its own name")


def _breaches(effect: OwnEffect, situation: Situation) -> Iterator[str]:
    """What its name, and where nothing is missing its coefficients, shapes and basis break of `Effect`.

    The basis is asked at the middle and the ends of grids.

    Raises:
        InputError: a call fails, or returns what is no list of coefficients, no shapes or no basis.
    """
    if not effect.name.strip() or not effect.name.isprintable():
        yield f"its name is {effect.name!r}, expected a word or two"
    if not of_library(effect.own) and effect.name in (*effect_names(situation.mechanism), OUTLIER):
        yield f"its name '{effect.name}' is one of the library's, which a verdict would mean; give it one of its own"
    if effect.missing(situation.mechanism, [*situation.covariates]):
        return
    found, shapes = effect.coefficients(situation), effect.shapes(situation)
    if all(c.secondary for c in found):
        none = "has no coefficient that is not secondary" if found else "returned no coefficient"
        yield f"coefficients() {none}; where there is nothing to fit, missing() must say why"
    names = [c.name for c in found] + [s.name for s in shapes]
    yield from name_breaches(names, "coefficients or shapes")
    for one in found:
        yield from (f"coefficients(): {breach}" for breach in _coefficient_breaches(one, situation))
    for shape in shapes:
        yield from (f"shapes(): {breach}" for breach in _shape_breaches(shape, len(found)))
    grids = [s.grid for s in shapes]
    middle, low, high = ([g[share * (len(g) - 1) // 2] for g in grids] for share in (1, 0, 2))
    at = torch.tensor(middle, dtype=torch.float64)
    if not torch.equal(effect.basis(situation, at), effect.basis(situation, at)):
        yield "basis() gives other values when called again; an effect draws no random numbers and keeps no state"
    if grids:
        # As a search asks: several sets of shapes at once.
        effect.basis(situation, torch.tensor([middle, low, high], dtype=torch.float64))


def _coefficient_breaches(one: Coefficient, situation: Situation) -> Iterator[str]:
    name, joints = f"coefficient '{one.name}'", [j.name for j in situation.mechanism.joints]
    legs = sorted({g.leg for g in situation.mechanism.geometry if g.leg is not None})
    if not (is_number(one.scale) and one.scale > 0):
        yield f"{name} has the scale {one.scale!r}, expected more than 0: its plausible size in {one.unit}"
    if one.joint is not None and one.joint not in joints:
        yield f"{name} is of joint {one.joint!r}, expected one of {', '.join(joints)}, or None"
    if one.leg is not None and one.leg not in legs:
        there = f"one of {', '.join(map(str, legs))}, or None" if legs else "None: the mechanism's parameters name none"
        yield f"{name} is of leg {one.leg!r}, expected {there}"
    yield from _unit_breaches(one.name, one.unit)


def _shape_breaches(shape: Shape, coefficients: int) -> Iterator[str]:
    name, grid = f"shape '{shape.name}'", shape.grid
    if not isinstance(grid, tuple | list) or not grid or not all(map(is_number, grid)):
        got = "is empty" if isinstance(grid, tuple | list) and not grid else f"is {grid!r}"
        yield f"the grid of {name} {got}, expected finite numbers to look at, e.g. (0.5, 1.0, 2.0)"
    if not all(a < b for a, b in pairwise(grid)):
        yield f"the grid of {name} does not ascend"
    if shape.usual is not None and not is_number(shape.usual):
        yield f"{name} has the usual value {shape.usual!r}, expected a number or None"
    if shape.columns is not None:
        wrong = [k for k in shape.columns if k not in range(coefficients)]
        if wrong or not shape.columns:
            named = f"names coefficient {wrong[0]!r}" if wrong else "names no coefficient"
            yield f"{name} {named} in columns, expected numbers from 0 to {coefficients - 1}, or None"
    yield from _unit_breaches(shape.name, shape.unit)


def _unit_breaches(name: str, unit: object) -> Iterator[str]:
    if not isinstance(unit, str):
        yield f"the unit of '{name}' is {unit!r}, expected a name of an SI unit such as 'm/N', or '1'"
        return
    try:
        one = float(to_si([1.0], unit, where="it")[0])
    except InputError as reason:
        yield f"the unit of '{name}' is none: {reason}"
        return
    if one != 1.0:
        yield f"the unit '{unit}' of '{name}' is no SI unit"


def name_breaches(names: Sequence[object], what: str) -> Iterator[str]:
    """What names of coefficients, shapes or numbers break: each has one, and one of its own."""
    for name in names:
        if not isinstance(name, str) or not name.strip():
            yield f"one of its {what} is called {name!r}, expected a name"
        if names.count(name) > 1:
            yield f"two of its {what} are called '{name}'; give each its own name"


def is_number(value: object) -> bool:
    """Whether it is a real, finite number."""
    return isinstance(value, Real) and math.isfinite(value)


EFFECTS: dict[str, Callable[[], Effect]] = {
    "tool": Tool,
    "geometry": Geometry,
    "joint_offset": JointOffset,
    "joint_gain": JointGain,
    "transmission": Transmission,
    "backlash": Backlash,
    "friction": Friction,
    "compliance": Compliance,
    "thermal_compliance": ThermalCompliance,
    "sag": Sag,
    "gravity": Gravity,
    "bending": Bending,
    "thermal": Thermal,
    "drift": Drift,
    "homing": Homing,
    "frame": Frame,
    "coupling": Coupling,
    "error_motion": ErrorMotion,
    "latency": Latency,
    "frame_drift": FrameDrift,
    "flexure": Flexure,
    "instrument": Instrument,
}
"""Name -> maker. The order is that of listings, and of what a verdict names where several do the very same: causes in
the machine first, the measuring device last."""

EXACT = frozenset({"geometry", "joint_offset", "joint_gain", "homing", "frame", "tool", "instrument"})
"""Effects whose form is kinematics: what they leave is something else, where friction, growth or a belt that couples
two joints may just be of another form than the textbook's."""

OUTLIER = "outlier"
"""What verdicts and simulations call bad rows. No effect: no other column foretells them."""


def make_effect(name: str, mechanism: Mechanism | None = None) -> Effect:
    """An effect by name, or from a user's `path/to/file.py:Name` (a class that is called without arguments).

    Args:
        name: of the library, of a file, or `parameter NAME` for a cause that the mechanism's parameters name.
        mechanism: the one that the effect is for.

    Raises:
        InputError: no effect has this name, or what the file has is no effect. What a user's own effect gives later is
            checked whenever it is asked (`OwnEffect`).
    """
    if is_plugin(name):
        make = load_plugin(name)
        with users_code(name, "making it without arguments "):
            effect = make()
        return owned(effect, name)
    if Path(name).suffix == ".py":
        raise InputError(f"effects: {class_hint(name)}")
    if name not in EFFECTS:
        own = {} if mechanism is None else {e.name: e for e in parameter_causes(mechanism)}
        plain = {_plain(n): e for n, e in own.items()}
        if _plain(name) in plain:
            return plain[_plain(name)]
        near = difflib.get_close_matches(name, [*EFFECTS, *own], 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        known = ", ".join([*EFFECTS, *own])
        raise InputError(f"effects: {name!r} is no effect of this version, which has {known}{hint}")
    return EFFECTS[name]()


def effect_names(mechanism: Mechanism) -> list[str]:
    """Of the library's effects that such a machine may have, and of the causes that its own parameters name."""
    without = ("gravity", "bending", "tool", "instrument") if sees_directions(mechanism) else (Flexure.name,)
    library = [name for name in EFFECTS if name not in without]
    return [*library, *(e.name for e in parameter_causes(mechanism))]


def _plain(name: str) -> str:
    return "_".join(name.lower().split())
