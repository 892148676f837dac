"""Named scalar quantities in SI: joints, pose coordinates, covariates and geometric parameters."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Coordinate", "Parameter"]


@dataclass(frozen=True)
class Coordinate:
    """A joint, a pose coordinate or a covariate, with its SI unit (``m``, ``rad``, ``s``, ``K``, ``N*m``, ``1`` …)."""

    name: str
    unit: str

    @property
    def header(self) -> str:
        """Column header of the contract, ``name[unit]``."""
        return f"{self.name}[{self.unit}]"


@dataclass(frozen=True)
class Parameter:
    """A geometric parameter of a mechanism: SI unit, nominal value, and the leg it belongs to (None = common)."""

    name: str
    unit: str
    nominal: float
    leg: int | None = None
