"""A user's effect with checked calls: an error becomes one sentence that names file and method."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from ccnn_torch.effects.protocol import Coefficient, Effect, Kind, Shape, missing_verbs
from ccnn_torch.effects.situation import Situation
from ccnn_torch.errors import CcnnError, InputError
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.plugins import failure

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
            return getattr(self.own, verb)(*given)
        except CcnnError:
            raise
        except (Exception, SystemExit) as error:  # a user's code may raise anything
            raise InputError(f"{self.label}: {verb}() {failure(error, self.label)}{_hint(error, given[0])}") from error

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
        return "pose channels", 3 if mechanism.frame(mechanism.home_pose)[1] is None else 6

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


def _hint(error: BaseException, given: object) -> str:
    """A column that is not there is what mostly lacks of a mapping by name."""
    if not (isinstance(error, KeyError) and isinstance(given, Situation)):
        return ""
    return f" (if that is a column: the rows have {', '.join(given.covariates) or 'none'}, and missing() must say so)"
