"""Error of a parameter of a simulator that is neither a length nor an angle."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ccnn_torch.coordinates import plausible_error
from ccnn_torch.effects.columns import caused_by, own_parameters, parameter_columns
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

PARAMETER = "parameter "
"""What the names of these effects begin with, before the cause's own."""


class ParameterCause:
    """Δp_k = c_k for the parameters of one cause."""

    kind: Kind = "parameters"
    ordered = False

    def __init__(self, cause: str) -> None:
        """cause: as the mechanism's parameters name it."""
        self.cause = cause
        self.name = f"{PARAMETER}{cause}"
        self.description = f"another value of {cause} than the model's"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A parameter of this cause."""
        return "" if caused_by(mechanism, self.cause) else f"a parameter of this cause: {mechanism.name} has none"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a parameter."""
        geometry = situation.mechanism.geometry
        chosen = [geometry[k] for k in caused_by(situation.mechanism, self.cause)]
        return tuple(Coefficient(p.name, p.unit, plausible_error(p), leg=p.leg) for p in chosen)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """Columns of the identity at every row, `... x s x k x m`."""
        return parameter_columns(situation, self.cause)


def parameter_causes(mechanism: Mechanism) -> list[ParameterCause]:
    """One for each cause that the mechanism's parameters name, in their order; none for most mechanisms."""
    causes = [mechanism.geometry[k].cause for k in own_parameters(mechanism)]
    return [ParameterCause(c) for c in dict.fromkeys(causes) if c not in (None, "geometry")]
