"""What an effect of motion is: numbers that change the parameters of an axis."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple


@dataclass(frozen=True)
class Facts:
    """What is known of one axis and of how it moved.

    Attributes:
        unit: of its position, `rad` or `m`.
        nominal: parameters of the nominal axis, as in `ABSENT`.
        gain: N m/rad (N/m) of its position control; None where it is not known. Torques are then told as the angle (or
            length) by which the command and the position must differ for them.
        length: lever of a load [m]; None where it is not known.
        carried: nearly the largest torque that 1 kg at the tool loads its motor with, over the gain [rad or m per kg];
            None where the model does not tell it.
        heaviest: no payload is heavier [kg]; None where nothing is known of it.
        span: of the command [rad or m].
        speed: nearly the largest one [per s].
        error: nearly the largest difference of command and position [rad or m].
        supply, temperature: largest relative change of the supply voltage, and of the temperature [K], in the logs.
        ripples: periods in a turn (in 2 pi m) that a torque, or the position, seems to repeat with.
    """

    unit: str
    nominal: Mapping[str, float]
    gain: float | None = None
    length: float | None = None
    carried: float | None = None
    heaviest: float | None = None
    span: float = 1.0
    speed: float = 1.0
    error: float = 0.1
    supply: float = 0.0
    temperature: float = 0.0
    ripples: tuple[float, ...] = ()

    @property
    def driven(self) -> bool:
        """Whether the nominal axis has a motor that works against something, so that its strength matters."""
        return any(self.nominal.get(name, 0.0) for name in ("inertia", "viscous", "gravity_sin", "gravity_cos"))


class Act(NamedTuple):
    """How a number changes a parameter of the axis: to it + factor * number, or to it * exp(factor * number)."""

    parameter: str
    factor: float
    how: Literal["add", "factor"]


def add(parameter: str, factor: float = 1.0) -> Act:
    """The number times a factor is added to a parameter."""
    return Act(parameter, factor, "add")


def scaled(parameter: str, factor: float = 1.0) -> Act:
    """The parameter is multiplied by exp(factor * number)."""
    return Act(parameter, factor, "factor")


@dataclass(frozen=True)
class Number:
    """One number of an effect.

    Attributes:
        name: in `diagnosis.json`.
        unit: `s`, `1`, `rad`, …; `torque` is a torque of the motor, `joint` the unit of the axis; empty where it is not
            known.
        scale: its plausible size.
        acts: on which parameters.
        start: where a fit begins, in plausible sizes.
        inverse: it is told as 1/number; one that only multiplies parameters as the change of the first, a share of it.
        model: the value in the model, where it is reported with the difference to it.
        most: its size is no larger, in its unit; None = any.
    """

    name: str
    unit: str
    scale: float
    acts: tuple[Act, ...]
    start: float = 0.3
    inverse: bool = False
    model: float | None = None
    most: float | None = None


@dataclass(frozen=True)
class MotionEffect:
    """One physical cause of a gap in motion; an entry of `EFFECTS`.

    Attributes:
        name: as in `diagnosis.json`.
        numbers: of an axis; every axis of a machine has the same ones.
        shapes: values that are tried for what a fit cannot reach step by step, by the name of a number (its start, in
            its unit; None: it stays 0), or of a parameter of the axis (held at it).
        missing: what these logs or this model lack to show it; empty where they can.
    """

    name: str
    numbers: Callable[[Facts], Sequence[Number]]
    shapes: Callable[[Facts], Sequence[Mapping[str, float | None]]] = lambda axis: ({},)
    missing: Callable[[Facts], str] = lambda axis: ""
