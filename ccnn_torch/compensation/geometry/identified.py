"""Identified geometry of a machine without closed forms, as a deviation of its joints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from ccnn_torch.mechanisms import Mechanism


class Geometry(Protocol):
    """A module from commanded joints to γ(q) = g(f(q)) - q, f the identified forward and g the nominal inverse
    kinematics.

    Attributes:
        export_tolerance: share of the limit to which exports agree, at most 1e-9.
    """

    export_tolerance: float

    def __call__(self, joints: Tensor) -> Tensor:
        """joints: `... x n` [SI]; returns γ, `... x n` [SI], finite for finite joints."""

    def describe(self) -> dict[str, Any]:
        """JSON with the key `kind`; see `register_network`."""


def geometric_deviation(
    mechanism: Mechanism, nominal: Tensor, identified: Tensor, guess: Tensor | None = None
) -> Callable[[Tensor], Tensor]:
    """The exact γ of one or many pairs of geometries.

    Args:
        nominal, identified: all parameters, `... x k` [SI], leading dims as the joints' to come.
        guess: poses near which forward kinematics are solved, `... x p` [SI]; the mechanism's home when None.
    """

    def exact(joints: Tensor) -> Tensor:
        pose = mechanism.forward_kinematics(joints, identified, guess)
        return mechanism.wrap(mechanism.solve_inverse(pose, nominal, joints) - joints)

    return exact
