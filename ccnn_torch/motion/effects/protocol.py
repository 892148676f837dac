"""What an effect of motion is: numbers that change the parameters of an axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

__all__ = ["Act", "Facts", "MotionEffect", "Number", "add", "scaled"]


@dataclass(frozen=True)
class Facts:
    """What is known of one axis and of how it moved.

    Attributes:
        unit: of its position, `rad` or `m`.
        nominal: parameters of the nominal axis, as in `ABSENT`.
        gain: N m/rad (N/m) of its position control; None where it is not known. Torques are then told as the angle (or
            length) by which the command and the position must differ for them.
        length: lever of a load [m]; None where it is not known.
        weight: torque of the weight of 1 kg there, times the sine and the cosine of the position [N m]; None: that of a
            lever that hangs down at 0.
        span: of the command [rad or m].
        speed, acceleration: nearly the largest ones of the command [per s, per s^2].
        error: nearly the largest difference of command and position [rad or m].
        supply, temperature: largest relative change of the supply voltage, and of the temperature [K], in the logs.
    """

    unit: str
    nominal: Mapping[str, float]
    gain: float | None = None
    length: float | None = None
    weight: tuple[float, float] | None = None
    span: float = 1.0
    speed: float = 1.0
    acceleration: float = 1.0
    error: float = 0.1
    supply: float = 0.0
    temperature: float = 0.0

    @property
    def driven(self) -> bool:
        """Whether the nominal axis has a motor that works against something, so that its strength matters."""
        return any(self.nominal.get(name, 0.0) for name in ("inertia", "viscous", "gravity_sin", "gravity_cos"))


class Act(tuple[str, float, Literal["add", "factor", "set"]]):
    """How a number changes a parameter of the axis: the parameter's name, a factor, and the operation.

    `add`: parameter + factor * number; `factor`: parameter * exp(factor * number); `set`: the number itself.
    """

    __slots__ = ()


def add(parameter: str, factor: float = 1.0) -> Act:
    """The number times a factor is added to a parameter."""
    return Act((parameter, factor, "add"))


def scaled(parameter: str, factor: float = 1.0) -> Act:
    """The parameter is multiplied by exp(factor * number)."""
    return Act((parameter, factor, "factor"))


@dataclass(frozen=True)
class Number:
    """One number of an effect.

    Attributes:
        name: in `diagnosis.json`.
        unit: `s`, `1`, `rad`, …; `torque` is a torque of the motor, `joint` the unit of the axis.
        scale: its plausible size.
        acts: on which parameters.
        start: where a fit begins, in plausible sizes.
        inverse: it is told as 1/number.
    """

    name: str
    unit: str
    scale: float
    acts: tuple[Act, ...]
    start: float = 0.3
    inverse: bool = False


class MotionEffect(Protocol):
    """One physical cause of a gap in motion; an entry of `EFFECTS`."""

    @property
    def name(self) -> str:
        """As in `diagnosis.json`."""
        ...

    def missing(self, axis: Facts) -> str:
        """What these logs or this model lack to show it; empty where they can."""
        ...

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        """Its numbers; every axis of a machine has the same ones."""
        ...

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        """Values that are tried for what a fit cannot reach step by step.

        By the name of a number (its start, in its unit), or of a parameter of the axis (held at it).
        """
        ...


@dataclass(frozen=True)
class Plain:
    """An effect with one number that is added to a parameter of the axis and can always be seen.

    Attributes:
        name: of the effect and of its number.
        parameter: of the axis.
        unit: as of `Number`.
        scale: plausible size.
        start: as of `Number`.
    """

    name: str
    parameter: str
    unit: str
    scale: float
    start: float = 0.3
    needs: str = field(default="")

    def missing(self, axis: Facts) -> str:
        return self.needs

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (Number(self.name, self.unit, self.scale, (add(self.parameter),), self.start),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)
