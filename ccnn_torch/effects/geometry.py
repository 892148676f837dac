"""Errors of the geometric parameters."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ccnn_torch.coordinates import plausible_error
from ccnn_torch.effects.columns import caused_by, parameter_columns
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism, SerialArm


class Geometry:
    """Δp_k = c_k, p = the mechanism's own lengths, angles and gains; base and tool frames are effects of their own.

    A parameter that names another cause (a simulator's stiffness) is a candidate of its own: `ParameterCause`.
    """

    name = "geometry"
    kind: Kind = "parameters"
    description = "lengths, places and angles of the machine as built that differ from its drawing"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Parameters."""
        return "" if caused_by(mechanism, self.name) else f"geometric parameters: mechanism '{mechanism.name}' has none"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a parameter."""
        mechanism = situation.mechanism
        chosen = caused_by(mechanism, self.name)
        # The parameters of an arm's link i come after its joint i.
        links = len(chosen) // len(mechanism.joints) if isinstance(mechanism, SerialArm) else 0
        return tuple(
            Coefficient(
                mechanism.geometry[k].name,
                mechanism.geometry[k].unit,
                plausible_error(mechanism.geometry[k]),
                joint=mechanism.joints[place // links].name if links else None,
                leg=mechanism.geometry[k].leg,
            )
            for place, k in enumerate(chosen)
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """Columns of the identity at every row, `... x s x k x m`."""
        return parameter_columns(situation, self.name)
