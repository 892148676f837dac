"""Named scalar quantities in SI: joints, pose coordinates, covariates and geometric parameters."""

from __future__ import annotations

from dataclasses import dataclass

from ccnn_torch.errors import InputError


@dataclass(frozen=True)
class Coordinate:
    """A joint, a pose coordinate or a covariate, with its SI unit (``m``, ``rad``, ``s``, ``K``, ``N*m``, ``1`` …)."""

    name: str
    unit: str

    @property
    def header(self) -> str:
        """Column header of the contract, ``name[unit]``."""
        return f"{self.name}[{self.unit}]"


def torque_of(joint: Coordinate) -> str:
    """The column of a drive's force or torque at rest."""
    return f"torque_{joint.name}"


def is_temperature(name: str) -> bool:
    """Whether a column is a temperature: `temperature`, and `temperature_NAME` of a part of the machine."""
    return name == "temperature" or name.startswith("temperature_")


def force_of(unit: str) -> str:
    """Unit of the force or moment along a coordinate of this unit."""
    return "N" if unit == "m" else "N*m"


def per_force(unit: str) -> str:
    """Unit of a compliance of a joint of this unit."""
    return f"{unit}/{'N' if unit == 'm' else 'N/m'}"


@dataclass(frozen=True)
class Condition(Coordinate):
    """A covariate that a simulator takes, with its SI value for records without that column.

    Attributes:
        usual: that value.
        spread: standard deviation about it in simulated records.
    """

    usual: float = 0.0
    spread: float = 0.0


@dataclass(frozen=True)
class Parameter:
    """A parameter of a mechanism: a length, an angle, a gain; of a simulator also a stiffness, a mass, a friction.

    Attributes:
        name: as configs and results name it.
        unit: SI unit.
        nominal: nominal value [SI].
        leg: number of the leg that it belongs to, and no other; joint i drives leg i. None = common to all.
        scale: plausible error of a machine as built [SI], one standard deviation; None = `plausible_error` of its
            unit.
        low, high: bounds [SI]; a simulator is never called beyond them. None = no bound.
        cause: name of its error in a diagnosis; the parameters of one cause are one candidate. None =
            ``geometry``, the lengths and angles of the machine as built.
        sense: which way it counts, where that is not the usual one (``clockwise``); or what it is, ``zero of joint 3``.
        word, shown: what people call it (``squareness xy``), and the unit that they tell it in (``um/m``); empty where
            its name and an SI unit do. An angle may be told as a slope.
        held: whether it stays at its nominal value unless a config names it free: it is exact, or another one stands
            for it.
        tied: parameters with one such text share one value unless a config ties others; empty = alone.
        same_as: effect and coefficient, ``joint_gain q1``, that do the very same and go by the same word.
    """

    name: str
    unit: str
    nominal: float
    leg: int | None = None
    scale: float | None = None
    low: float | None = None
    high: float | None = None
    cause: str | None = None
    sense: str = ""
    word: str = ""
    shown: str = ""
    held: bool = False
    tied: str = ""
    same_as: str = ""


_PLAUSIBLE = {"m": 1e-3, "rad": 2e-3, "1": 2e-3}


def plausible_error(parameter: Parameter) -> float:
    """How far a parameter of a machine as built may plausibly be off [SI], one standard deviation.

    Its own `scale`; without one, 1 mm, 2 mrad or 2e-3 [1], about what ordinary manufacture and assembly leave.

    Raises:
        InputError: no scale, and a unit that has none by default.
    """
    if parameter.scale is not None:
        return parameter.scale
    if parameter.unit not in _PLAUSIBLE:
        raise InputError(
            f"parameter '{parameter.name}' has the unit '{parameter.unit}': give it a scale, its plausible error in SI"
        )
    return _PLAUSIBLE[parameter.unit]
