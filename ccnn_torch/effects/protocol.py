"""The protocol of an effect. A new effect is one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from torch import Tensor

from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

Kind = Literal["joints", "parameters", "pose"]


@dataclass(frozen=True)
class Coefficient:
    """A parameter that the effect is linear in; 0 = the effect is absent.

    Attributes:
        name: as results name it, with the joint or leg that it belongs to, e.g. ``q2`` or ``leg 1 l``.
        unit: SI unit.
        scale: plausible size in a machine as built [unit], one standard deviation.
        joint: name of the joint that it belongs to alone, or None.
        leg: number of the leg that it belongs to alone, or None.
        secondary: whether it describes what the textbook form leaves out (a stiffening spring, a second harmonic); a
            simulation leaves it 0 unless given.
        borrowed: whether alone it is what another effect does (a constant part): it is no evidence for this
            one.
        mends: whether it is but a correction of the form of the others, and cannot be many times as large as they are.
        positive: whether physics allows it no negative value (backlash, compliance); for drawing it in a simulation.
        part: name of a part of the effect that may be there or not for itself, with a size of its own: growth by a
            second thermometer, short waves of a rail; empty = none.
    """

    name: str
    unit: str
    scale: float
    joint: str | None = None
    leg: int | None = None
    secondary: bool = False
    borrowed: bool = False
    mends: bool = False
    positive: bool = False
    part: str = ""


@dataclass(frozen=True)
class Shape:
    """A parameter that the effect is not linear in: a period, a lag, a width. Found by search over `grid`.

    Attributes:
        name: as results name it.
        unit: SI unit.
        grid: values to look at, ascending; the search refines between neighbours and never leaves the grid's ends.
        columns: which coefficients depend on it, or None where all do; shapes without a common coefficient are
            searched one by one.
        refined: whether values between those of the grid are possible.
        usual: what a simulation takes unless given; drawn from the lower half of the grid where None.
        alike: shapes with one such text, and one grid, are of parts that are made alike, and likely have one value;
            empty = it is like no other.
        told: the value that the machine's file tells, or None.
        moments: of a time from which on rows are others, where that may be; of these it is one in the end.
    """

    name: str
    unit: str
    grid: tuple[float, ...]
    columns: tuple[int, ...] | None = None
    usual: float | None = None
    refined: bool = True
    alike: str = ""
    told: float | None = None
    moments: tuple[float, ...] = ()

    @property
    def textbook(self) -> float | None:
        """The value that needs no search: the usual one, or the first of those that are counted (once a turn)."""
        return self.grid[0] if self.usual is None and not self.refined else self.usual


@runtime_checkable
class Effect(Protocol):
    """One physical cause, linear in its coefficients for given shapes; a class that derives from it has what is given.

    The same object is injected in a simulation, fitted in a diagnosis, and used in a compensator.

    Attributes:
        name: by which configs and verdicts call it.
        kind: what it changes: the ``joints`` that the machine really takes, the mechanism's ``parameters``, or the
            measured ``pose`` (position and rotation vector in the base frame).
        description: one line for people.
        ordered: whether it needs the rows in the order measured.
    """

    name: str
    kind: Kind
    description: str
    ordered: bool = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """What the records lack for it, in words that say which column to add; empty where nothing is missing."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Its `m` coefficients on this mechanism with these covariates."""

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """Its `h` shapes; () where it has none."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """Change per unit of each coefficient.

        Args:
            situation: `... x s` rows.
            shape: `... x h` [SI].

        Returns:
            `... x s x d x m`, d = joints [joint's unit], parameters [parameter's unit], or channels of the pose (3
            without orientation, else 6) [m, rad], each per unit of the coefficient. Finite for every finite input.
        """


_VERBS = ("missing", "coefficients", "shapes", "basis")
_KINDS = ("joints", "parameters", "pose")


def missing_verbs(effect: object) -> list[str]:
    """What `effect` lacks of `Effect`."""
    lacking = [verb for verb in _VERBS if not callable(getattr(effect, verb, None))]
    lacking += [a for a in ("name", "description") if not isinstance(getattr(effect, a, None), str)]
    if getattr(effect, "kind", None) not in _KINDS:
        lacking.append(f"kind (one of {', '.join(_KINDS)})")
    if not isinstance(getattr(effect, "ordered", None), bool):
        lacking.append("ordered (True or False)")
    return lacking
